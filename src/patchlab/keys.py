"""Document every key of the studies' configs as Markdown, and write an example config of each study."""

from typing import get_type_hints

from patchlab.study.study import STUDIES, load_study
from patchproof.app.keys import Documents, default_text, meanings, tables, toml_text
from patchproof.base.validation import models_in

HEAD = """# Keys of studies

Printed by `patchlab keys`; for scenes and pages see `patchproof keys`.
"""


def documents() -> Documents:
    """By study: a line that says what its config is for, and its settings class."""
    studies = {name: load_study(name) for name in STUDIES}
    return {
        name: (f"`patchlab study {name} --config FILE.toml`: {study.about}", study.settings)
        for name, study in studies.items()
    }


# example values of required keys: files that a user has or can make
_EXAMPLES = {
    "scenes": ("scene.toml",),
    "run": "run",
    "networks": ("builtin",),
    "models": ("builtin",),
    "classes": ("mug", "carton"),
    "renders": ("scene.toml",),  # or images with labels
    "images": "images",
    "labels": "labels.csv",
    "photos": ("photos",),
    "patches": "patches",
    "kind": "charuco",
}


def example_config(name: str) -> str:
    """A TOML config to start from: required keys are set, all others stand at their defaults, commented out."""
    study = load_study(name)
    lines = [f"# {study.about}", f"# patchlab study {name} --config {name}.toml --out {name}"]
    for path, model in tables(study.settings):
        required = not path or study.settings.model_fields[path.strip("[]").partition(".")[0]].is_required()
        if path:
            lines += ["", f"{'' if required else '# '}{path.replace(']', '.mine]') if required else path}"]
        for key, field in model.model_fields.items():
            if any(True for _ in models_in(get_type_hints(model)[key])):
                continue  # a table of its own
            live = required and (field.is_required() or (key == "renders" and field.default == ()))
            meaning = meanings(model).get(key, "")
            value = toml_text(_EXAMPLES[key]) if live else default_text(field).strip("`")
            value = value if value not in ("none", "required") else "..."
            lines.append(f"{'' if live else '# '}{key} = {value}{'  # ' if meaning else ''}{meaning}")
    return "\n".join(lines) + "\n"
