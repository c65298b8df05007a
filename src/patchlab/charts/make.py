"""Make the three charts: each a folder with its finished cells, tables, picture and page.

In: the packaged pairs of object and network; those whose files lie in the folder that PATCHPROOF_DATA names are left
out where it names none. Out: `OUT/NAME/NAME_chart.png`, `NAME.json` and so on. A killed chart is resumed; the same
cells give the same bytes.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from patchlab.charts import breaks, speed, terms
from patchlab.study.study import DEFAULT_WORK, FinishedStudy, Study, Work, run_cells
from patchproof.base.errors import Refused
from patchproof.base.output import make_folder
from patchproof.base.validation import spelling_hint, validate_model

CHARTS: dict[str, Study] = {study.STUDY.name: study.STUDY for study in (breaks, terms, speed)}
_RESULTS = Path(__file__).parents[1] / "results"
OWN_PAIRS = ("speed/truck.toml", "charts/chair.toml")
DATA_PAIRS = (
    "layouts/postbox_025.toml",
    "layouts/light_025.toml",
    "layouts/suv_075.toml",
    "layouts/pickup_squeeze.toml",
)
_QUICK: dict[str, dict[str, Any]] = {
    "breaks": {"photos": 2, "draws": 30},
    "terms": {"steps": 8, "n": 32, "rounds": 2},
    "speed": {
        "efforts": {"draft": (4, 16), "default": (12, 32), "thorough": (36, 64)},
        "n": 40,
        "ceiling": {"pairs": 1, "steps": 48, "seeds": 1, "places": 2},
        "photos": 3,
        "sizes_px": ((640, 480), (1600, 1200)),
    },
}


def make_charts(name: str, out: Path, quick: bool = False, work: Work = DEFAULT_WORK) -> dict[str, FinishedStudy]:
    """Make one chart, or `all`, in folders of `out`; returns them by name."""
    if name not in ("all", *CHARTS):
        raise Refused("the name of a chart", f'"{name}"', spelling_hint(name, ("all", *CHARTS)))
    make_folder(out)
    names = CHARTS if name == "all" else (name,)
    return {each: run_cells(CHARTS[each], chart_settings(each, quick), _RESULTS, out / each, work) for each in names}


def chart_settings(name: str, quick: bool, environment: Mapping[str, str] = os.environ):
    """A chart's settings: all pairs that are at hand, quick ones with a tenth of everything."""
    scenes = OWN_PAIRS + (DATA_PAIRS if environment.get("PATCHPROOF_DATA") else ())
    given = {"scenes": scenes} if "scenes" in CHARTS[name].settings.model_fields else {}
    return validate_model(CHARTS[name].settings, given | (_QUICK[name] if quick else {}), f"the chart {name}")
