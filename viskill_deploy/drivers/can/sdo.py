"""Reads and writes of a drive's dictionary: canopen's SDO client, without its threads."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial

from viskill_deploy.core.errors import DriverError, MissingExtraError
from viskill_deploy.drivers.can.codec import SDO_ANSWER_ID, SDO_REQUEST_ID
from viskill_deploy.drivers.can.line import CanLine, Frame
from viskill_deploy.drivers.can.objects import DriveObject, final

try:
    from canopen import Network, ObjectDictionary
    from canopen.sdo import SdoClient
    from canopen.sdo.exceptions import SdoError
except ImportError as error:
    raise MissingExtraError("can", "the CAN driver") from error

PATIENCE = 600
"""How often is listened for an answer: 0.3 s at half a millisecond each."""


class _Wire(Network):  # type: ignore[misc]  # canopen has no types
    """canopen's network on a line that somebody else reads."""

    def __init__(self, line: CanLine) -> None:
        super().__init__()
        self._line = line

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        del remote
        self._line.send(can_id, bytes(data))


class DriveDictionary(SdoClient):  # type: ignore[misc]
    """One drive's dictionary.

    Args:
        line: its bus.
        node_id: its number there.
        name: how messages call it.
        listen: waits a moment and returns the frames that have arrived.
    """

    def __init__(
        self, line: CanLine, node_id: int, name: str, listen: Callable[[], list[Frame]]
    ) -> None:
        super().__init__(SDO_REQUEST_ID + node_id, SDO_ANSWER_ID + node_id, ObjectDictionary())
        self.network = _Wire(line)
        self._name, self._listen = name, listen

    def configure(self, objects: tuple[DriveObject, ...]) -> None:
        """Writes objects in order, and reads every one back.

        Raises:
            DriverError: one was refused or reads otherwise than it was written; names it.
        """
        for entry in objects:
            self._ask(entry, partial(self.download, entry.index, entry.sub, entry.data))
        for entry in final(objects):
            kept = self.value(entry)
            if kept != entry.value:
                raise DriverError(
                    f"{self._name}: object {entry.key} ({entry.name}) reads {kept} after "
                    f"{entry.value} was written; a drive that does not keep it cannot be used"
                )
        for can_id, _ in self._listen():
            self._check_single(can_id)

    def value(self, entry: DriveObject) -> int:
        """What an object reads.

        Raises:
            DriverError: it cannot be read.
        """
        data = self._ask(entry, lambda: self.upload(entry.index, entry.sub))
        return int.from_bytes(data or b"", "little", signed=entry.is_signed)

    def read_response(self) -> bytes:
        """Listens on the line until the drive has answered; for canopen."""
        for _ in range(PATIENCE):
            for can_id, data in self._listen():
                if can_id == self.tx_cobid:
                    self.on_response(can_id, data, 0.0)
            if not self.responses.empty():
                break
        else:
            raise DriverError(
                f"{self._name} does not answer; look at power, plug, bit rate and node id"
            )
        response: bytes = super().read_response()
        if not self.responses.empty():
            self._check_single(self.tx_cobid)
        return response

    def request_response(self, sdo_request: bytes) -> bytes:
        """One request, one answer: what comes now answers no request."""
        for can_id, _ in self._listen():
            self._check_single(can_id)
        self.send_request(sdo_request)
        return self.read_response()

    def _check_single(self, can_id: int) -> None:
        if can_id == self.tx_cobid:
            raise DriverError(
                f"{self._name} has answered twice: two drives have one node id; give each its own"
            )

    def _ask(self, entry: DriveObject, call: Callable[[], bytes | None]) -> bytes | None:
        try:
            return call()
        except (SdoError, struct.error) as error:
            raise DriverError(
                f"{self._name}: object {entry.key} ({entry.name}) is refused ({error}); "
                "see docs/can.md for what a drive has to have"
            ) from error
