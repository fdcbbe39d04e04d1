"""Data out of pickles, without executing them.

A pickle is a program for a stack machine that may call anything. `load` runs it on Python's own
reader with a restricted instruction table: only what containers, numbers, strings and arrays need,
and only names for which the caller passes a builder. It is the pure-Python reader, because the one
in C allocates memory for any length or index that a file claims. Anything else raises ValueError;
the number of instructions is bounded.
"""

from __future__ import annotations

import dataclasses
import pickle
import struct
from collections.abc import Callable, Mapping
from typing import IO, Any

MOST_INSTRUCTIONS = 1_000_000  # a tensor takes about 50, a network has hundreds of tensors
Builder = Callable[..., Any]

_Python: Any = pickle._Unpickler  # type: ignore[attr-defined]
_STEPS = """proto frame mark stop none true false empty_list empty_dictionary empty_tuple tuple1
    tuple2 tuple3 tuple list dict append appends setitem setitems put binput long_binput memoize get
    binget long_binget int long long1 long4 binint binint1 binint2 float binfloat string binstring
    short_binstring unicode binunicode short_binunicode binunicode8 binbytes short_binbytes
    binbytes8 global stack_global reduce newobj build binpersid"""
_KNOWN = frozenset(f"load_{step}" for step in _STEPS.split())
_DAMAGE = (pickle.UnpicklingError, EOFError, struct.error, IndexError, KeyError, TypeError,
           AttributeError, AssertionError, OverflowError, MemoryError)


class Refused(ValueError):
    """The pickle may be intact but asks for something that is not allowed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Named:
    """A name that the pickle mentions, with the builder called in its place."""

    name: str
    build: Builder

    def __call__(self, *arguments: Any) -> Any:
        return self.build(*arguments)


class Inert:
    """Stands for an object whose content does not matter; it holds nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        pass


_FLAT = (str, int, float, bytes, type(None), Named, Inert)


def load(
    file: IO[bytes], names: Mapping[str, Builder], persistent: Builder | None = None
) -> Any:
    """The object of the pickle at the file's position, which moves past it.

    file: in memory, or of a `BoundedPath`, which never allocates more than the file holds.
    names: "module.name" -> the function called in its place. persistent: called with each
    persistent id. Raises Refused, a ValueError, for other names and instructions, and ValueError
    for damage of any kind.
    """
    reader = _Reader(file, names, persistent)
    try:
        value = reader.load()
    except _DAMAGE as e:
        raise ValueError(f"the pickle is damaged ({type(e).__name__}: {e})") from e
    if reader.stack or reader.metastack or isinstance(value, Named):
        raise ValueError("the pickle ends with values left over")
    return value


def _is_key(value: Any) -> bool:
    """Only flat keys: hashing deeply nested tuples would overflow the stack."""
    return isinstance(value, _FLAT) or (
        type(value) is tuple and all(isinstance(part, _FLAT) for part in value))


class _Reader(_Python):
    """Python's reader with its own names, persistent ids and operations on objects."""

    def __init__(
        self, file: IO[bytes], names: Mapping[str, Builder], persistent: Builder | None
    ) -> None:
        super().__init__(file, encoding="latin-1")
        self.names, self.persistent = names, persistent
        self.dispatch = _Table({code: getattr(_Reader, step.__name__) for code, step
                                in _Python.dispatch.items() if step.__name__ in _KNOWN})

    def find_class(self, module: str, name: str) -> Named:
        name = f"{module}.{name}"
        if name not in self.names:
            raise Refused(f"the pickle names {name[:80]!r}, which no weights need: refused")
        return Named(name, self.names[name])

    def persistent_load(self, identity: Any) -> Any:
        if self.persistent is None:
            raise ValueError("the pickle refers to data outside of it")
        return self.persistent(identity)

    load_newobj = _Python.load_reduce

    def load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if hasattr(target, "set_state"):
            target.set_state(state)
        elif not isinstance(target, Inert | dict):  # attributes of an OrderedDict are unused
            raise ValueError("the pickle sets the state of an object without one")

    def load_append(self) -> None:
        self._extend([self.stack.pop()])

    def load_appends(self) -> None:
        self._extend(self.pop_mark())

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is list:
            self.stack[-1].extend(items)
        elif not isinstance(self.stack[-1], Inert):
            raise ValueError("the pickle appends to something that is not a list")

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._fill(items)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._fill([key, value])

    def load_setitems(self) -> None:
        self._fill(self.pop_mark())

    def _fill(self, items: list[Any]) -> None:
        if isinstance(self.stack[-1], Inert):
            return
        if type(self.stack[-1]) is not dict or len(items) % 2:
            raise ValueError("the pickle sets items of what is no dict, or a key without a value")
        if not all(map(_is_key, items[::2])):
            raise Refused("the pickle has a dict with keys of a kind that no weights need")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))


class _Table(dict[int, Callable[[Any], None]]):
    """Instructions by their opcode; counts them up to the limit."""

    left = MOST_INSTRUCTIONS

    def __getitem__(self, code: int) -> Callable[[Any], None]:
        self.left -= 1
        if self.left < 0:
            raise ValueError(f"the pickle has more than {MOST_INSTRUCTIONS} instructions")
        if code not in self:
            raise Refused(f"the pickle has the instruction {code:#x}, which no weights need")
        return super().__getitem__(code)
