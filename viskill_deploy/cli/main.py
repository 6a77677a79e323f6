"""The `viskill` command.

Exit codes: 0 ran as it should · 1 a required figure was not met · 2 usage · 3 bad data · 4 driver ·
5 safety stop · 6 missing extra · 70 a bug · 130 interrupted.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import traceback

# One thread each: the control loop's small matrices only lose time to a pool of them.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import typer

from viskill_deploy.cli import (
    bring,
    calibrate,
    can,
    check,
    convert,
    doctor,
    dry_run,
    evaluate,
    execute,
    export,
    faults,
    guard,
    inspect,
    reproduce,
    serve,
    sweep,
    train,
)
from viskill_deploy.core.errors import DataFileError, Interrupted, ViskillError
from viskill_deploy.observe.labels import with_labels

BUG = 70

REFUSED = {
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG),
    *(errno.EEXIST, errno.ENOTDIR, errno.EISDIR),
}
"""What a path refuses."""

app = typer.Typer(
    name="viskill",
    help="Train ViSkill policies and deploy them on the da Vinci Research Kit, safely.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("dry-run", epilog=dry_run.EXAMPLE)(dry_run.command)
app.command("execute", epilog=execute.EXAMPLE)(execute.command)
app.command("guard", epilog=guard.EXAMPLE)(guard.command)
app.command("faults", epilog=faults.EXAMPLE)(faults.command)
app.command("check", epilog=check.EXAMPLE)(check.command)
app.command("inspect", epilog=inspect.EXAMPLE)(inspect.command)
app.command("doctor", epilog=doctor.EXAMPLE)(doctor.command)
app.command("train", epilog=train.EXAMPLE)(train.command)
app.command("evaluate", epilog=evaluate.EXAMPLE)(evaluate.command)
app.command("sweep", epilog=sweep.EXAMPLE)(sweep.command)
app.command("reproduce", epilog=reproduce.EXAMPLE)(reproduce.command)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(can.app, name="can")
app.command("convert", epilog=convert.EXAMPLE)(convert.command)
app.add_typer(export.app, name="export")
app.add_typer(bring.app, name="import")
app.add_typer(serve.app, name="serve")


def main() -> None:
    """Runs a command; an error becomes one plain sentence and its exit code."""
    # A shell starts what it puts in the background with SIGINT ignored; it shall stop all the same.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        app()
    except ViskillError as error:
        print(f"viskill: {with_labels(str(error))}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("viskill: interrupted", file=sys.stderr)
        sys.exit(Interrupted.exit_code)
    except OSError as error:
        advice = _advice(error)
        if advice is None:
            traceback.print_exc()
            sys.exit(_bug())
        where = f"{error.filename}: " if error.filename else ""
        print(f"viskill: {where}{error.strerror}; {advice}", file=sys.stderr)
        sys.exit(DataFileError.exit_code)
    except Exception:  # noqa: BLE001 - the last edge: a bug gets an exit code of its own
        traceback.print_exc()
        sys.exit(_bug())


def _advice(error: OSError) -> str | None:
    """What to do about what a disk or a path refuses; None for anything else, which is a bug."""
    if error.errno in {errno.ENOSPC, errno.EDQUOT}:
        return "make room, then give the command again"
    if error.errno in REFUSED and error.filename:
        return "name another path, or see to its rights"
    return None


def _bug() -> int:
    print("viskill: this is a bug; please report it with the lines above", file=sys.stderr)
    return BUG


if __name__ == "__main__":
    main()
