"""QGIS styles (.qml) of the result layers: a few rules a layer, filled into small templates.

QGIS loads a `.qml` of a layer's name by itself; in a GeoPackage the
same text stands in `layer_styles`. Written for QGIS 3.22, read by every later 3.x.
"""

from __future__ import annotations

from dataclasses import dataclass
from string import Template
from types import MappingProxyType
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from geofleet.formats.palette import (
    BLACK,
    BLUE,
    GOSPA_M_CLASSES,
    GREEN,
    GREY,
    LIGHT_GREY,
    ORANGE,
    SKY_BLUE,
    VERMILLION,
    rgb,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

_DOCUMENT = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|MapTips">
{style}</qgis>
"""
_STYLE = Template(
    """ <renderer-v2 type="RuleRenderer" symbollevels="0" forceraster="0" enableorderby="0">
  <rules key="root">
$rules
  </rules>
  <symbols>
$symbols
  </symbols>
 </renderer-v2>
 <previewExpression>$title</previewExpression>
 <mapTip>$tip</mapTip>
"""
)
_RULE = Template("   <rule key=$key symbol=$key label=$label filter=$filter/>")
_SYMBOL = Template(
    """   <symbol name=$key type=$kind alpha="1" clip_to_extent="1" force_rhr="0">
    <layer class=$drawing pass="0" locked="0" enabled="1">
     <Option type="Map">
$options
     </Option>
    </layer>
   </symbol>"""
)
_OPTION = Template('      <Option type="QString" name=$name value=$value/>')
_KINDS = MappingProxyType({"SimpleMarker": "marker", "SimpleLine": "line", "SimpleFill": "fill"})


@dataclass(frozen=True, slots=True)
class Rule:
    """Features that a QGIS expression selects, how they are drawn, and their line in the legend."""

    label: str
    expression: str
    drawing: str
    options: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Style:
    """How a layer looks: its rules, an expression that names a feature, and the properties that a map tip shows."""

    rules: tuple[Rule, ...]
    title: str
    tip: tuple[str, ...]

    def qml(self) -> str:
        """Return the style as a QML document."""
        return _DOCUMENT.format(style=self.elements())

    def elements(self) -> str:
        """Return renderer, title and map tip as elements of a QML document or of a layer of a project."""
        rules, symbols = [], []
        for number, rule in enumerate(self.rules):
            key = quoteattr(str(number))
            rules.append(_RULE.substitute(key=key, label=quoteattr(rule.label), filter=quoteattr(rule.expression)))
            options = "\n".join(
                _OPTION.substitute(name=quoteattr(name), value=quoteattr(value)) for name, value in rule.options.items()
            )
            symbols.append(
                _SYMBOL.substitute(
                    key=key,
                    kind=quoteattr(_KINDS[rule.drawing]),
                    drawing=quoteattr(rule.drawing),
                    options=options,
                )
            )
        tip = "&lt;br&gt;".join(f"{name}: [% &quot;{name}&quot; %]" for name in self.tip)
        title = f"&quot;{self.title}&quot;"
        return _STYLE.substitute(rules="\n".join(rules), symbols="\n".join(symbols), title=title, tip=tip)


def _marker(label: str, expression: str, shape: str, *, fill: str, line: str, size_mm: float) -> Rule:
    """Return a rule that draws points; `fill` and `line` are `r,g,b` or `r,g,b,alpha`."""
    options = {"name": shape, "color": fill, "outline_color": line, "size": str(size_mm), "outline_width": "0.5"}
    return Rule(label, expression, "SimpleMarker", options | {"outline_style": "solid", "size_unit": "MM"})


def _area(label: str, expression: str, *, fill: str, line: str, pattern: str = "solid", width_mm: float = 0.3) -> Rule:
    """Return a rule that draws polygons."""
    options = {"color": fill, "style": pattern, "outline_color": line, "outline_width": str(width_mm)}
    return Rule(label, expression, "SimpleFill", options | {"outline_style": "solid"})


def _line(label: str, *, colour: str, width_mm: float, pattern: str = "solid") -> Rule:
    """Return a rule that draws lines."""
    options = {"line_color": rgb(colour), "line_style": pattern, "line_width": str(width_mm)}
    return Rule(label, "", "SimpleLine", options | {"capstyle": "round", "joinstyle": "round"})


def _tiles() -> tuple[Rule, ...]:
    """Return a rule a class of GOSPA_M; tiles without a score are hatched, not left out."""
    rules, low = [], 0.0
    for high, colour in GOSPA_M_CLASSES:
        if high is None:
            label, upper = f"GOSPA_M from {low} m", ""
        else:
            label, upper = f"GOSPA_M {low} to {high} m", f' AND "gospa_m" < {high}'
        rules.append(_area(label, f'"gospa_m" >= {low}{upper}', fill=rgb(colour, 150), line=rgb(GREY)))
        low = high or low
    null = _area("nothing matched", '"gospa_m" IS NULL', fill=rgb(VERMILLION), line=rgb(GREY), pattern="b_diagonal")
    return (*rules, null)


STYLES: Mapping[str, Style] = MappingProxyType(
    {
        "scores": Style(_tiles(), "tile", ("tile", "gospa_m", "f1", "tp", "fp", "fn", "null_reason")),
        "ellipses": Style(
            (_area("95 % error ellipse", "", fill=rgb(SKY_BLUE, 60), line=rgb(SKY_BLUE)),),
            "sign_id",
            ("sign_class", "semi_major_m", "semi_minor_m", "orientation_deg"),
        ),
        "match_lines": Style(
            (_line("match", colour=ORANGE, width_mm=0.5),),
            "fused_id",
            ("ref_class", "distance_m"),
        ),
        "reference": Style(
            (_marker("reference sign", "", "circle", fill="255,255,255,0", line=rgb(GREY), size_mm=5.0),),
            "sign_id",
            ("sign_class", "source", "source_ref"),
        ),
        "fused": Style(
            (_marker("sign of the map", "", "square", fill=rgb(BLACK), line=rgb(BLACK), size_mm=1.2),),
            "sign_id",
            ("sign_class", "source", "source_ref"),
        ),
        "matches": Style(
            (
                _marker("found (TP)", "\"outcome\" = 'TP'", "circle", fill=rgb(GREEN), line=rgb(BLACK), size_mm=2.6),
                _marker(
                    "not in the reference (FP)",
                    "\"outcome\" = 'FP'",
                    "cross2",
                    fill=rgb(VERMILLION),
                    line=rgb(VERMILLION),
                    size_mm=3.6,
                ),
                _marker(
                    "missed (FN)", "\"outcome\" = 'FN'", "diamond", fill="255,255,255", line=rgb(BLUE), size_mm=3.8
                ),
            ),
            "outcome",
            ("outcome", "ref_class", "fused_class", "distance_m"),
        ),
    }
)
# Of what a result lies on.
GROUND_STYLES: Mapping[str, Style] = MappingProxyType(
    {
        "drives": Style((_line("drive", colour=BLACK, width_mm=0.4, pattern="dash"),), "drive_id", ("drive_id",)),
        "roads": Style(
            (_line("road", colour=LIGHT_GREY, width_mm=1.0),), "road_id", ("road_id", "kind", "speed_limit_kmh")
        ),
    }
)
