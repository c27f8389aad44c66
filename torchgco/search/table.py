"""A solver's table of passes: what every row of it is, and all of them by name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self, overload

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_options

KINDS = ("free", "moving", "maps", "bodies")  # of problems: without obstacles, where no path can be sought, and others


class Row:
    """A row of the table, and each step of one.

    `among` of a row says for which kind of problem it is, `when` for which problems of that kind, by what the rows
    before have brought.

    Attributes:
        label: how errors name its options.
        seeks_paths: whether it needs obstacles among which the roadmap can seek a path.
        kinds: of problems that it may work on.
        last: whether only a last answer is worth it; a planner that solves again soon leaves it out.
        problems: which problems it looks at, in words.
        does: what it does with them, in words.
    """

    label: ClassVar[str] = "pass"
    seeks_paths: ClassVar[bool] = False
    last: ClassVar[bool] = False
    kinds: Any = KINDS
    problems: Any
    does: Any

    def __post_init__(self) -> None:
        check_options(self, self.label)

    @property
    def steps(self) -> tuple[Row, ...]:
        """What the row does one after another; a step is its own."""
        return (self,)

    def run(self, search: Any) -> None:
        """All steps, on the state of a search (`search.Search`)."""
        for number, step in enumerate(self.steps):
            if number > 0 and search.begun:
                if search.call.late:
                    return
                search.best.next_attempt()
            step.run(search)

    def fitting(self, m: int) -> Self:
        """The same row for vehicles with m controls."""
        return self


class Passes(tuple[Row, ...]):
    """The rows of a table by name, in their order: `passes.paths`, `passes["paths"]`, `passes[3]`.

    Rows without names are named after their classes. Two tables are equal where their rows are.
    """

    names: tuple[str, ...]
    steps: tuple[Row, ...]  # of all rows

    def __new__(cls, rows: Mapping[str, Row] | Iterable[Row] = ()) -> Self:
        if isinstance(rows, Mapping):
            names, rows = [str(name) for name in rows], tuple(rows.values())
        else:
            known = rows.names if isinstance(rows, Passes) else None
            rows = tuple(rows)
            names = list(known or _named(rows))
        made = super().__new__(cls, rows)
        made.names = tuple(names)
        made.steps = tuple(step for row in made for step in row.steps)
        return made

    def __reduce__(self) -> tuple[type[Passes], tuple[dict[str, Row]]]:
        return Passes, (dict(self.items()),)

    @overload  # type: ignore[override]
    def __getitem__(self, key: int | str) -> Any: ...
    @overload
    def __getitem__(self, key: slice) -> tuple[Row, ...]: ...
    def __getitem__(self, key: int | str | slice) -> Any:
        if isinstance(key, str):
            if key not in self.names:
                raise InputError("solver.passes", f"one of {', '.join(self.names)}", key)
            key = self.names.index(key)
        return super().__getitem__(key)

    def __getattr__(self, name: str) -> Any:
        if name == "names" or name not in self.names:
            raise AttributeError(name)
        return self[name]

    def keys(self) -> tuple[str, ...]:
        """The names: with these, `{**passes, "paths": ...}` and `dict(passes)` are mappings of rows by name."""
        return self.names

    def items(self) -> Iterator[tuple[str, Row]]:
        """Names and rows."""
        return zip(self.names, self, strict=True)

    def changed(self, **rows: Row | None) -> Passes:
        """The same table with other rows in the places of these, or without them where None is given.

        Raises:
            InputError: a name that no row has.
        """
        for name in rows:
            self[name]
        both = ((name, rows.get(name, row) if name in rows else row) for name, row in self.items())
        return Passes({name: row for name, row in both if row is not None})


def passes_of(value: Any) -> Passes:
    """The table of a mapping or list of rows.

    Raises:
        InputError: anything else, or something in it that is no row.
    """
    if not isinstance(value, list | tuple | Mapping):
        raise InputError("solver.passes", "a list of passes of torchgco.search, or a mapping by name", shown(value))
    for place, one in value.items() if isinstance(value, Mapping) else enumerate(value):
        if not isinstance(one, Row):
            at = f".{place}" if isinstance(value, Mapping) else f"[{place}]"
            raise InputError(f"solver.passes{at}", "a pass of torchgco.search", shown(one))
    return Passes(value)


def _named(rows: Sequence[Row]) -> list[str]:
    """Names after the classes, with numbers where one occurs again."""
    names: list[str] = []
    for row in rows:
        name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(row).__name__).lower()
        again = sum(other == name or other.startswith(f"{name}_") for other in names)
        names.append(name if again == 0 else f"{name}_{again + 1}")
    return names
