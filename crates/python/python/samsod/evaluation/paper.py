"""The figures of the paper's tables 4 to 9, to stand beside ours.

The paper gives places in centimetres in tables 4, 6, 7 and 8 and in millimetres in tables A.1 and A.2; here all are in
millimetres. The angular errors of table 5 are headed "(%)", those of tables 6 to 8 "(deg)": they are taken for degrees.
Its "sets" are pictures of several objects, its "objects" the six parts of its pick and place. It gives no detection
rate for the conventional methods ("not applicable").
"""

from __future__ import annotations

from dataclasses import dataclass

from samsod.evaluation.spread import Spread


def _mm(mean_cm: float, deviation_cm: float) -> Spread:
    return Spread(10.0 * mean_cm, 10.0 * deviation_cm)


@dataclass(frozen=True)
class Places:
    """A row of places: errors along x and y in mm."""

    x: Spread
    y: Spread


@dataclass(frozen=True)
class Recognised:
    """What one method reached of one row: angle error in degrees, recognition rate in %, places where it has them."""

    angle: Spread | None
    rate: float
    places: Places | None = None


@dataclass(frozen=True)
class Row:
    """A set or an object.

    Attributes:
        name: as the paper calls it.
        before, after: places before and after the separation of shadows (tables 4 and 7); all were detected.
        sift, shape: recognition in salient regions (tables 5 and 7).
        conventional_sift, conventional_shape: recognition in the whole image (tables 6 and 8).
    """

    name: str
    before: Places
    after: Places
    sift: Recognised
    shape: Recognised
    conventional_sift: Recognised
    conventional_shape: Recognised


def _places(x: tuple[float, float], y: tuple[float, float]) -> Places:
    return Places(_mm(*x), _mm(*y))


def _whole(
    x: tuple[float, float], y: tuple[float, float], angle: tuple[float, float], rate: float = 100.0
) -> Recognised:
    return Recognised(Spread(*angle), rate, _places(x, y))


def _regions(angle: tuple[float, float], rate: float = 100.0) -> Recognised:
    return Recognised(Spread(*angle), rate)


#: Tables 4, 5 and 6.
SETS = (
    Row(
        "Set2",
        before=_places((0.23, 0.03), (0.18, 0.05)),
        after=_places((0.09, 0.06), (0.08, 0.05)),
        sift=_regions((2.3, 0.5)),
        shape=_regions((1.0, 0.4)),
        conventional_sift=_whole((0.48, 0.06), (0.35, 0.03), (4.8, 0.3)),
        conventional_shape=_whole((0.19, 0.06), (0.21, 0.08), (1.8, 0.4)),
    ),
    Row(
        "Set3",
        before=_places((0.13, 0.03), (0.21, 0.06)),
        after=_places((0.08, 0.05), (0.11, 0.06)),
        sift=_regions((3.2, 0.3), 70.0),
        shape=_regions((0.9, 0.3)),
        conventional_sift=_whole((0.62, 0.02), (0.74, 0.06), (6.4, 0.5), 41.0),
        conventional_shape=_whole((0.21, 0.02), (0.27, 0.06), (2.1, 0.6)),
    ),
    Row(
        "Set4",
        before=_places((0.12, 0.02), (0.14, 0.03)),
        after=_places((0.10, 0.03), (0.09, 0.04)),
        sift=_regions((5.1, 0.7), 41.0),
        shape=_regions((2.1, 0.2)),
        conventional_sift=_whole((0.57, 0.04), (0.46, 0.05), (3.7, 0.7), 60.0),
        conventional_shape=_whole((0.19, 0.08), (0.16, 0.03), (1.9, 0.3)),
    ),
    Row(
        "Set5",
        before=_places((0.11, 0.04), (0.14, 0.06)),
        after=_places((0.11, 0.04), (0.13, 0.06)),
        sift=_regions((3.4, 0.7), 82.0),
        shape=_regions((1.4, 0.6)),
        conventional_sift=_whole((0.33, 0.07), (0.41, 0.08), (5.4, 0.7), 70.0),
        conventional_shape=_whole((0.14, 0.03), (0.31, 0.03), (2.1, 0.6)),
    ),
)

#: Tables 7 and 8.
OBJECTS = (
    Row(
        "Object1",
        before=_places((0.21, 0.05), (0.18, 0.045)),
        after=_places((0.06, 0.02), (0.04, 0.03)),
        sift=_regions((3.2, 0.4)),
        shape=_regions((1.2, 0.5)),
        conventional_sift=_whole((0.383, 0.03), (0.283, 0.03), (3.5, 0.5)),
        conventional_shape=_whole((0.25, 0.06), (0.27, 0.05), (2.4, 0.6)),
    ),
    Row(
        "Object2",
        before=_places((0.16, 0.035), (0.21, 0.05)),
        after=_places((0.09, 0.03), (0.07, 0.02)),
        sift=_regions((2.1, 0.6)),
        shape=_regions((0.9, 0.3)),
        conventional_sift=_whole((0.29, 0.05), (0.31, 0.07), (2.7, 0.2)),
        conventional_shape=_whole((0.18, 0.04), (0.23, 0.05), (1.6, 0.4)),
    ),
    Row(
        "Object3",
        before=_places((0.15, 0.03), (0.16, 0.035)),
        after=_places((0.09, 0.04), (0.11, 0.04)),
        sift=_regions((3.6, 0.2)),
        shape=_regions((0.6, 0.2)),
        conventional_sift=_whole((0.28, 0.05), (0.35, 0.04), (3.3, 0.6)),
        conventional_shape=_whole((0.29, 0.06), (0.24, 0.05), (1.8, 0.5)),
    ),
    Row(
        "Object4",
        before=_places((0.14, 0.049), (0.23, 0.055)),
        after=_places((0.10, 0.05), (0.12, 0.06)),
        sift=_regions((2.5, 0.5)),
        shape=_regions((0.8, 0.4)),
        conventional_sift=_whole((0.31, 0.04), (0.23, 0.06), (3.6, 0.4)),
        conventional_shape=_whole((0.22, 0.03), (0.29, 0.02), (2.3, 0.6)),
    ),
    Row(
        "Object5",
        before=_places((0.24, 0.06), (0.21, 0.052)),
        after=_places((0.08, 0.03), (0.09, 0.05)),
        sift=_regions((1.9, 0.7)),
        shape=_regions((1.1, 0.3)),
        conventional_sift=_whole((0.32, 0.03), (0.41, 0.05), (2.9, 0.5)),
        conventional_shape=_whole((0.31, 0.05), (0.38, 0.06), (1.9, 0.4)),
    ),
    Row(
        "Object6",
        before=_places((0.16, 0.035), (0.19, 0.04)),
        after=_places((0.12, 0.04), (0.15, 0.06)),
        sift=_regions((2.2, 0.5)),
        shape=_regions((1.2, 0.6)),
        conventional_sift=_whole((0.26, 0.05), (0.27, 0.04), (2.9, 0.3)),
        conventional_shape=_whole((0.20, 0.06), (0.32, 0.07), (3.4, 0.3)),
    ),
)


@dataclass(frozen=True)
class Times:
    """Times in ms a pixel, as in table 9; None was not measured."""

    saliency: float | None
    shadow: float | None
    sift: float | None
    shape: float | None
    conventional_sift: float | None
    conventional_shape: float | None

    @property
    def with_sift(self) -> float | None:
        """Total with recognition by SIFT."""
        return _sum(self.saliency, self.shadow, self.sift)

    @property
    def with_shape(self) -> float | None:
        """Total with recognition by shape."""
        return _sum(self.saliency, self.shadow, self.shape)

    @property
    def sift_ratio(self) -> float | None:
        """Total with SIFT by that of the conventional method."""
        return _ratio(self.with_sift, self.conventional_sift)

    @property
    def shape_ratio(self) -> float | None:
        """Total with shape by that of the conventional method."""
        return _ratio(self.with_shape, self.conventional_shape)


def _sum(*values: float | None) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None


def _ratio(ours: float | None, conventional: float | None) -> float | None:
    return ours / conventional if ours is not None and conventional else None


#: Table 9. The text gives the ratios as 0.36:1 and 0.0038:1; those of the printed times are 0.352 and 0.0038.
TIMES = Times(saliency=0.07, shadow=0.006, sift=0.10, shape=0.19, conventional_sift=0.5, conventional_shape=69.8)
