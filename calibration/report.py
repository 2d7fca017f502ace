"""What a calibration is worth: residuals, hold-out error, uncertainty, and a verdict with its reasons."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

Verdict = Literal["good", "doubtful", "refused"]
Level = Literal["note", "warning", "refused"]


@dataclass(frozen=True)
class Finding:
    """One reason. A `refused` one keeps the calibration out of calibration.json."""

    level: Level
    text: str


@dataclass(frozen=True)
class Report:
    """One calibration's figures by name (unit in the name) and what follows from them.

    `residuals`: on the data used; `hold_out`: on data kept aside; `uncertainty`: standard deviations of the result;
    `details`: whatever else is worth keeping (rejected views, coverage, ...).
    """

    kind: str
    residuals: Mapping[str, Any]
    hold_out: Mapping[str, Any]
    uncertainty: Mapping[str, Any]
    findings: tuple[Finding, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        levels = {f.level for f in self.findings}
        return "refused" if "refused" in levels else "doubtful" if "warning" in levels else "good"

    def with_findings(self, more: Iterable[Finding]) -> Report:
        return replace(self, findings=(*self.findings, *more))

    def reasons(self) -> list[str]:
        return [f"{f.level}: {f.text}" for f in self.findings]

    def to_json(self) -> dict[str, Any]:
        """As kept under `residuals` of calibration.json."""
        return {
            "verdict": self.verdict,
            "reasons": self.reasons(),
            "residuals": _rounded(self.residuals),
            "hold_out": _rounded(self.hold_out),
            "uncertainty": _rounded(self.uncertainty),
            **_rounded(self.details),
        }

    def text(self) -> str:
        lines = [f"{self.kind}: {self.verdict}"]
        for title, figures in (
            ("residuals", self.residuals),
            ("hold-out", self.hold_out),
            ("uncertainty (1 sigma)", self.uncertainty),
        ):
            if figures:
                lines.append(f"  {title}")
                lines += [f"    {name}: {_said(value)}" for name, value in figures.items()]
        lines += [f"  {reason}" for reason in self.reasons()]
        return "\n".join(lines)


def limit(value: float, what: str, unit: str, fine: float, most: float) -> list[Finding]:
    """Nothing up to `fine`, a warning up to `most`, refused beyond or where the value is not known."""
    if not math.isfinite(value):
        return [Finding("refused", f"{what} is not known")]
    if value <= fine:
        return []
    return [
        Finding("warning" if value <= most else "refused", f"{what} is {value:.3g} {unit}, wanted at most {fine:g}")
    ]


def undetected(images: int, where: str = "") -> list[Finding]:
    """What is said of images on which the tag detector died twice: they count as if nothing were seen in them."""
    if not images:
        return []
    text = f"{where}the tag detector died on {images} images: tags in them are missing here: run it again"
    return [Finding("warning", f"{text}; where they stay lost, look at the recording with `toss-view`")]


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_said(v)}" for k, v in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " ".join(_said(v) for v in value)
    return str(value)


def _rounded(value: Any) -> Any:
    """JSON values, six significant digits, NaN as None."""
    if isinstance(value, Mapping):
        return {str(k): _rounded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    if hasattr(value, "tolist"):
        return _rounded(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
