"""Data out of pickles, without running them.

A pickle is a program for a stack machine that may call anything. `load` is such a machine that
can call nothing but the functions it is handed by name: plain containers, numbers and strings
need none. It works on the decoded instructions (`pickletools.genops`, which checks every length
against the bytes that are there), so nothing of the pickle is ever executed. ValueError for
everything it will not do; the number of instructions is bounded.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from typing import IO, Any

MOST_INSTRUCTIONS = 1_000_000  # a tensor takes about 50, and networks have hundreds
Builder = Callable[..., Any]

_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = frozenset((
    "INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT", "STRING",
    "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"))
_EMPTY: dict[str, Builder] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MARK = object()


class Refused(ValueError):
    """The pickle is as its writer left it, perhaps, but asks for what is not to be done."""


class Named:
    """A name the pickle mentions, with the builder that stands for it."""

    def __init__(self, name: str, build: Builder) -> None:
        self.name, self.build = name, build


class Inert:
    """What stands for an object of which only the presence matters; it holds nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        pass


_FLAT = (str, int, float, bytes, type(None), Named, Inert)


def load(
    file: IO[bytes], names: Mapping[str, Builder], persistent: Builder | None = None
) -> Any:
    """The object of the pickle at the file's position, which moves behind it.

    names: "module.name" -> what is called in its place. persistent: called with each persistent
    id. Raises Refused, a ValueError, for other names and unknown instructions, and ValueError for
    every kind of damage.
    """
    machine = _Machine(names, persistent)
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(file)):
            if count >= MOST_INSTRUCTIONS:
                raise ValueError(f"it has more than {MOST_INSTRUCTIONS} instructions")
            if opcode.name == "STOP":
                return machine.result()
            machine.step(opcode.name, argument)
    except (IndexError, KeyError, TypeError, AttributeError, OverflowError, MemoryError) as e:
        raise ValueError(f"the pickle is damaged ({type(e).__name__}: {e})") from e
    raise ValueError("the pickle does not end")


def _is_key(value: Any) -> bool:
    """Tuples in tuples could be nested so deep that hashing them overflows the stack."""
    return isinstance(value, _FLAT) or (
        type(value) is tuple and all(isinstance(part, _FLAT) for part in value))


class _Machine:
    """Stack and memo of one pickle."""

    def __init__(self, names: Mapping[str, Builder], persistent: Builder | None) -> None:
        self.names, self.persistent = names, persistent
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def result(self) -> Any:
        value = self.stack.pop()
        if self.stack or value is _MARK or isinstance(value, Named):
            raise ValueError("the pickle ends with values left over")
        return value

    def step(self, name: str, argument: Any) -> None:
        """Carry out one instruction."""
        push = self.stack.append
        if name in _VALUES:
            push(argument)
        elif name in _CONSTANTS:
            push(_CONSTANTS[name])
        elif name in _EMPTY:
            push(_EMPTY[name]())
        elif name in _TUPLES:
            push(tuple(self._pop(_TUPLES[name])))
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self.memo[argument] = self.stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            push(self.memo[argument])
        elif name not in ("PROTO", "FRAME"):
            getattr(self, f"_do_{name.lower()}", self._refuse(name))(argument)

    def _refuse(self, name: str) -> Builder:
        def refused(_: Any) -> None:
            raise Refused(f"the pickle has the instruction {name}, which no weights need")
        return refused

    def _pop(self, count: int) -> list[Any]:
        if len(self.stack) < count:
            raise ValueError("the pickle takes more than it put")
        taken = self.stack[len(self.stack) - count:]
        del self.stack[len(self.stack) - count:]
        if any(value is _MARK for value in taken):
            raise ValueError("the pickle takes across a mark")
        return taken

    def _to_mark(self) -> list[Any]:
        at = len(self.stack) - 1
        while self.stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise ValueError("the pickle has no mark")
        taken = self.stack[at + 1:]
        del self.stack[at:]
        return taken

    def _do_mark(self, _: Any) -> None:
        self.stack.append(_MARK)

    def _do_tuple(self, _: Any) -> None:
        self.stack.append(tuple(self._to_mark()))

    def _do_list(self, _: Any) -> None:
        self.stack.append(self._to_mark())

    def _do_dict(self, _: Any) -> None:
        items = self._to_mark()
        self.stack.append({})
        self._set_items(items)

    def _do_append(self, _: Any) -> None:
        self._extend(self._pop(1))

    def _do_appends(self, _: Any) -> None:
        self._extend(self._to_mark())

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is list:
            self.stack[-1].extend(items)
        elif not isinstance(self.stack[-1], Inert):
            raise ValueError("the pickle appends to what is no list")

    def _do_setitem(self, _: Any) -> None:
        self._set_items(self._pop(2))

    def _do_setitems(self, _: Any) -> None:
        self._set_items(self._to_mark())

    def _set_items(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if isinstance(target, Inert):
            return
        if type(target) is not dict:
            raise ValueError("the pickle sets items of what is no plain dict")
        if not all(map(_is_key, items[::2])):
            raise Refused("the pickle has a dict with keys of a kind that no weights need")
        if len(items) % 2:
            raise ValueError("the pickle has a key without a value")
        target.update(zip(items[::2], items[1::2], strict=True))

    def _do_global(self, argument: str) -> None:
        self._name(argument.replace(" ", ".", 1))

    def _do_stack_global(self, _: Any) -> None:
        parts = self._pop(2)
        if not all(isinstance(part, str) for part in parts):  # a nested list would be spelled out
            raise ValueError("the pickle names what is no string")
        self._name(".".join(parts))

    def _name(self, name: str) -> None:
        if name not in self.names:
            raise Refused(f"the pickle names {name[:80]!r}, which no weights need: refused")
        self.stack.append(Named(name, self.names[name]))

    def _do_reduce(self, _: Any) -> None:
        function, arguments = self._pop(2)
        if not isinstance(function, Named) or not isinstance(arguments, tuple):
            raise ValueError("the pickle calls what is no function")
        self.stack.append(function.build(*arguments))

    _do_newobj = _do_reduce

    def _do_build(self, _: Any) -> None:
        state, = self._pop(1)
        target = self.stack[-1]
        if hasattr(target, "set_state"):
            target.set_state(state)
        elif not isinstance(target, Inert | dict):  # an OrderedDict's attributes: none of use
            raise ValueError("the pickle sets the state of what has none")

    def _do_binpersid(self, _: Any) -> None:
        identity, = self._pop(1)
        if self.persistent is None:
            raise ValueError("the pickle refers to data outside of it")
        self.stack.append(self.persistent(identity))
