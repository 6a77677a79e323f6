"""Pickles as data: a reader that knows the few instructions that a `torch.save` dict is made of.

It is an interpreter of its own, not Python's unpickler: what a pickle names is looked up in the
table that the caller gives and nowhere else, so nothing outside that table can run. Instructions,
names and sizes that no checkpoint needs are refused.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

MAX_BYTES = 4 * 2**20
"""The largest official pickle has 61 kB: tensors lie beside it."""

MAX_INSTRUCTIONS = 500_000
MAX_DEPTH = 1_000
"""Values on the stack at a time; an official pickle needs some 80."""

PLAIN = frozenset({"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE"})
CONSTANTS: Mapping[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class PickleRefusedError(ValueError):
    """A pickle holds what no checkpoint needs, or is broken; the text says what."""


@runtime_checkable
class Stateful(Protocol):
    """A stand-in for an object: takes the state that the pickle gives it."""

    def set_state(self, state: Any) -> None:
        """Takes over the state."""
        ...


class _Mark:
    """Where a group of values begins on the stack."""


MARK = _Mark()


def read_pickle(
    content: bytes, names: Mapping[str, Callable[..., Any]], persistent: Callable[[Any], Any]
) -> Any:
    """The value that a pickle of protocol 2 describes.

    Args:
        content: the pickle.
        names: what may be called, by "module.name": functions that make data out of data.
        persistent: gives the object that a persistent id stands for.

    Raises:
        PickleRefusedError: an instruction or a name that is not known, or a broken pickle.
    """
    if len(content) > MAX_BYTES:
        raise PickleRefusedError(
            f"its pickle has {len(content)} bytes, a checkpoint's has far less"
        )
    reader = _Reader(names, persistent)
    try:
        for count, (instruction, argument, _) in enumerate(pickletools.genops(content)):
            if count > MAX_INSTRUCTIONS or len(reader.stack) > MAX_DEPTH:
                raise PickleRefusedError("its pickle is far longer than a checkpoint's")
            if instruction.name == "STOP":
                return reader.result()
            reader.take(instruction.name, argument)
    except PickleRefusedError:
        raise
    except (ValueError, TypeError, IndexError, KeyError, OverflowError) as error:
        raise PickleRefusedError(f"its pickle is broken ({error})") from error
    raise PickleRefusedError("its pickle is broken (it has no end)")


class _Reader:
    """The stack machine: values, groups and what was put aside."""

    def __init__(
        self, names: Mapping[str, Callable[..., Any]], persistent: Callable[[Any], Any]
    ) -> None:
        self._names, self._persistent = names, persistent
        self.stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def take(self, instruction: str, argument: Any) -> None:
        """Carries out one instruction."""
        if instruction in PLAIN:
            self.stack.append(argument)
        elif instruction in CONSTANTS:
            self.stack.append(CONSTANTS[instruction])
        elif instruction in TUPLES:
            self.stack.append(tuple(self._last(TUPLES[instruction])))
        else:
            step = getattr(self, f"_do_{instruction.lower()}", None)
            if step is None:
                raise PickleRefusedError(
                    f"its pickle holds the instruction {instruction}, which no checkpoint needs"
                )
            step(argument)

    def result(self) -> Any:
        """The one value that is left."""
        (value,) = self.stack
        return value

    def _pop(self) -> Any:
        value = self.stack.pop()
        if value is MARK:
            raise ValueError("a group is empty that must not be")
        return value

    def _last(self, count: int) -> list[Any]:
        return [self._pop() for _ in range(count)][::-1]

    def _group(self) -> list[Any]:
        values = []
        while (value := self.stack.pop()) is not MARK:
            values.append(value)
        return values[::-1]

    def _do_proto(self, version: int) -> None:
        if version != 2:
            raise PickleRefusedError(f"its pickle has protocol {version}, torch.save writes 2")

    def _do_mark(self, _: Any) -> None:
        self.stack.append(MARK)

    def _do_empty_dict(self, _: Any) -> None:
        self.stack.append({})

    def _do_empty_list(self, _: Any) -> None:
        self.stack.append([])

    def _do_tuple(self, _: Any) -> None:
        self.stack.append(tuple(self._group()))

    def _do_binput(self, index: int) -> None:
        self._memo[index] = self.stack[-1]

    _do_long_binput = _do_binput

    def _do_binget(self, index: int) -> None:
        self.stack.append(self._memo[index])

    _do_long_binget = _do_binget

    def _do_setitem(self, _: Any) -> None:
        self._store(self._last(2))

    def _do_setitems(self, _: Any) -> None:
        self._store(self._group())

    def _store(self, flat: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict) or not all(isinstance(key, str) for key in flat[::2]):
            raise ValueError("an entry is put into something that is no table of names")
        target.update(zip(flat[::2], flat[1::2], strict=True))

    def _do_append(self, _: Any) -> None:
        value = self._pop()
        self._list().append(value)

    def _do_appends(self, _: Any) -> None:
        values = self._group()
        self._list().extend(values)

    def _list(self) -> list[Any]:
        target = self.stack[-1]
        if not isinstance(target, list):
            raise ValueError("a value is put into something that is no list")
        return target

    def _do_global(self, argument: str) -> None:
        name = argument.replace(" ", ".")
        if name not in self._names:
            raise PickleRefusedError(
                f"its pickle names {name}, which no checkpoint needs: it may be an attack, and "
                "nothing of it was run"
            )
        self.stack.append(self._names[name])

    def _do_reduce(self, _: Any) -> None:
        function, arguments = self._last(2)
        if not any(function is known for known in self._names.values()):
            raise ValueError("something is called that is no name")
        self.stack.append(function(*arguments))

    _do_newobj = _do_reduce

    def _do_build(self, _: Any) -> None:
        state = self._pop()
        target = self.stack[-1]
        if not isinstance(target, Stateful):
            raise ValueError("a state is given to something that takes none")
        target.set_state(state)

    def _do_binpersid(self, _: Any) -> None:
        self.stack.append(self._persistent(self._pop()))
