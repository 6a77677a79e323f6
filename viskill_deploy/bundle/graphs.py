"""ONNX graphs of a bundle: opened from checked bytes, held to a signature, run a row at a time.

A graph's first output is its answer; any others are for people and are left alone.
"""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from viskill_deploy.core.errors import BundleError
from viskill_deploy.core.types import FloatArray

ORT_ERRORS: tuple[type[Exception], ...] = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NoSuchFile,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
    MemoryError,
    RuntimeError,
    ValueError,
)
"""ONNX Runtime's errors share no base class."""

NO_FOLDER = "/dev/null"
"""Where a graph may look for weights in other files: nothing lies below a device. By default ONNX
Runtime takes them from the working directory, unseen by any hash."""

MEMORY_BYTES = 512 * 2**20
"""What opening and running a graph may take. Two kilobytes of graph can ask for terabytes."""

STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class Signature:
    """What a graph takes and gives: names and widths of float32 tensors [N, width].

    Attributes:
        inputs: width of every input.
        output: name of the first output.
        width: its width.
    """

    inputs: Mapping[str, int]
    output: str
    width: int


@dataclass(frozen=True, slots=True)
class Affine:
    """From the task's numbers to a policy's: `scale * x + offset`, entry by entry."""

    scale: FloatArray
    offset: FloatArray

    def __call__(self, x: FloatArray) -> FloatArray:
        """A vector of the task as the policy wants it."""
        return self.scale * x + self.offset

    def back(self, y: FloatArray) -> FloatArray:
        """A vector of the policy as the task wants it."""
        return (y - self.offset) / self.scale


@dataclass(frozen=True)
class Graph:
    """A graph that has the signature that its bundle needs; it runs on one thread.

    Attributes:
        path: the file, for messages.
        signature: what it takes and gives.
        session: ONNX Runtime's.
        inward: what an adapter does to each input, by its name; nothing by default.
        outward: what an adapter has done to the numbers of the answer; nothing by default.
    """

    path: Path
    signature: Signature
    session: onnxruntime.InferenceSession
    inward: Mapping[str, Affine] = field(default_factory=dict)
    outward: Affine | None = None

    def adapted(self, inward: Mapping[str, Affine], outward: Affine | None = None) -> Graph:
        """The same graph behind an adapter: it takes and gives the task's own numbers."""
        return replace(self, inward=inward, outward=outward)

    def __call__(self, *inputs: FloatArray) -> FloatArray:
        """The answer to one row, (width,), which need not be finite.

        Args:
            inputs: one vector an input, in the order of the signature.

        Raises:
            BundleError: the graph cannot run, or answers in another shape than it declares; ONNX
                Runtime takes a declaration at its word.
        """
        rows = zip(self.signature.inputs, inputs, strict=True)
        changed = ((n, self.inward[n](x) if n in self.inward else x) for n, x in rows)
        feed = {name: values[None].astype(np.float32) for name, values in changed}
        try:
            (answer,) = self.session.run([self.signature.output], feed)
        except ORT_ERRORS as error:
            raise BundleError(self.path, f"cannot run: {error}; export it again") from error
        if answer.shape != (1, self.signature.width):
            raise BundleError(
                self.path,
                f"answers {list(answer.shape)} to one row, declares "
                f"[N, {self.signature.width}]; export it again",
            )
        told = np.asarray(answer[0], dtype=np.float64)
        return told if self.outward is None else self.outward.back(told)


def open_graph(path: Path, content: bytes, signature: Signature) -> Graph:
    """The graph in `content`.

    Args:
        path: where the bytes came from, for messages.
        content: the very bytes that were hashed.
        signature: what it has to take and give.

    Raises:
        BundleError: it is no ONNX graph, takes or gives something else, needs other files, or
            cannot answer zeros within `MEMORY_BYTES`.
    """
    with _little_memory():
        graph = _opened(path, content, signature)
        graph(*(np.zeros(width) for width in signature.inputs.values()))
    return graph


def _opened(path: Path, content: bytes, signature: Signature) -> Graph:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path", NO_FOLDER
    )
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except ORT_ERRORS as error:
        raise BundleError(path, f"is no usable ONNX graph ({error}); export it again") from error
    for wanted, nodes in (
        (signature.inputs, session.get_inputs()),
        ({signature.output: signature.width}, session.get_outputs()[:1]),
    ):
        found = {node.name: (node.type, len(node.shape), *node.shape[-1:]) for node in nodes}
        expected = {name: ("tensor(float)", 2, width) for name, width in wanted.items()}
        if found != expected:
            raise BundleError(
                path, f"has {found}, the manifest says {expected}; export the bundle again"
            )
    return Graph(path, signature, session)


@contextlib.contextmanager
def _little_memory() -> Iterator[None]:
    """Lets this process take `MEMORY_BYTES` more and not all of the machine, where Linux can."""
    if not STATM.exists():
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(STATM.read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    wanted = used + MEMORY_BYTES
    resource.setrlimit(
        resource.RLIMIT_AS, (wanted if soft == resource.RLIM_INFINITY else min(soft, wanted), hard)
    )
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
