"""The lenses that are fitted: a model, and which of its coefficients stay 0."""

from __future__ import annotations

from dataclasses import dataclass, replace

from recordings.geometry import COEFFICIENTS, CameraModel, DistortionModel


@dataclass(frozen=True)
class LensForm:
    """A lens model of which so many of the last coefficients stay 0, and how it is called."""

    kind: DistortionModel
    still: int = 0
    name: str = ""

    def __str__(self) -> str:
        return self.name or self.kind

    @property
    def coefficients(self) -> int:
        return COEFFICIENTS[self.kind] - self.still

    def bare(self, start: CameraModel) -> CameraModel:
        """This lens with nothing bent."""
        return replace(start, distortion_model=self.kind, distortion=(0.0,) * COEFFICIENTS[self.kind])


WITHOUT_K3 = LensForm("brown-conrady", 1, "brown-conrady without k3")


def still_numbers(model: CameraModel) -> int:
    """Of a lens that was fitted before: Brown's k3, its last number, stays away where it was left out."""
    bends = any(model.distortion) and model.distortion_model == WITHOUT_K3.kind
    return WITHOUT_K3.still if bends and not model.distortion[-1] else 0
