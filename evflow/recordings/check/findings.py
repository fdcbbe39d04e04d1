"""Findings with stable codes, and the report that collects them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from typing import Literal

from evflow.errors import CODES, EvflowDataError
from evflow.notes import Note

Severity = Literal["error", "warning", "note"]


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing to know about a recording. `str(finding)` is one line, as of an `EvflowDataError`.

    Attributes:
        code: one of `CODES`.
        severity: "error" = results would be wrong, "warning" = a part is lost or doubtful,
            "note" = good to know.
        seen: what was found, and where.
        fix: what to do about it; may be "".
    """

    code: str
    severity: Severity
    seen: str
    fix: str = ""

    @staticmethod
    def of(error: EvflowDataError) -> Finding:
        """A finding from an error that a reader or a constructor raised.

        Args:
            error: the error.

        Returns:
            A finding of severity "error".
        """
        return Finding(error.code, "error", error.seen, error.fix)

    def note(self) -> Note:
        """The finding as a note with its code."""
        return Note(self.code, str(self))

    def error(self) -> EvflowDataError:
        """The finding as an exception."""
        return EvflowDataError(self.code, self.seen, self.fix)

    def __str__(self) -> str:
        return f"{self.code} {CODES[self.code]}: {self.seen}{' ' + self.fix if self.fix else ''}"


@dataclasses.dataclass(frozen=True)
class Report:
    """What `check` found in a recording. `str(report)` has one line per finding.

    Attributes:
        findings: all of them; `errors`, `warnings` and `notes` are those of one severity.
    """

    findings: tuple[Finding, ...] = ()

    @property
    def errors(self) -> tuple[Finding, ...]:
        """What makes results wrong."""
        return self._only("error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What makes a part of the recording useless or doubtful."""
        return self._only("warning")

    @property
    def notes(self) -> tuple[Finding, ...]:
        """What is good to know."""
        return self._only("note")

    def raise_if_failed(self) -> None:
        """Raise the first error, if there is any.

        Raises:
            EvflowDataError: of that finding's code.
        """
        if self.errors:
            raise self.errors[0].error()

    def strict(self) -> Report:
        """The same with every warning turned into an error."""
        return Report(tuple(
            dataclasses.replace(f, severity="error") if f.severity == "warning" else f
            for f in self.findings))

    def as_dict(self) -> dict[str, list[dict[str, str]]]:
        """{"errors", "warnings", "notes"}: lists of {"code", "title", "seen", "fix"}."""
        def rows(findings: Iterable[Finding]) -> list[dict[str, str]]:
            return [{"code": f.code, "title": CODES[f.code], "seen": f.seen, "fix": f.fix}
                    for f in findings]

        return {"errors": rows(self.errors), "warnings": rows(self.warnings),
                "notes": rows(self.notes)}

    def to_json(self) -> str:
        """`as_dict` as indented JSON."""
        return json.dumps(self.as_dict(), indent=2)

    def __str__(self) -> str:
        return "\n".join(f"{f.severity}: {f}" for f in self.findings) or "nothing found"

    def _only(self, severity: Severity) -> tuple[Finding, ...]:
        return tuple(f for f in self.findings if f.severity == severity)
