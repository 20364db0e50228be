"""Colours that every picture, page and QGIS layer of a result shares.

Okabe and Ito's, which the colour-blind tell apart (https://jfly.uni-koeln.de/color/); outcomes differ in shape too, for
print without colour. Tiles go from light to dark, so that their order survives without colour.
"""

from __future__ import annotations

BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#999999"
LIGHT_GREY = "#D0D0D0"

# Where something is drawn beside others of its kind, e.g. a method of several; black is what the paper printed.
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY_BLUE, GREY)

# GOSPA_M in metres, each class up to and without its bound.
GOSPA_M_CLASSES = (
    (0.5, "#FFFFCC"),
    (1.0, "#A1DAB4"),
    (1.5, "#41B6C4"),
    (2.0, "#2C7FB8"),
    (None, "#253494"),
)


def rgb(colour: str, alpha: int | None = None) -> str:
    """Return `#RRGGBB` as `r,g,b`, or `r,g,b,alpha` (0 to 255), as QGIS writes it."""
    parts = [str(int(colour[start : start + 2], 16)) for start in (1, 3, 5)]
    return ",".join(parts if alpha is None else [*parts, str(alpha)])


def gospa_m_colour(gospa_m: float | None) -> str | None:
    """Return the colour of the class of a score; None where nothing matched."""
    if gospa_m is None:
        return None
    return next(colour for bound, colour in GOSPA_M_CLASSES if bound is None or gospa_m < bound)
