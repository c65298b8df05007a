"""Find a network's output indices from the words of a scene file.

A label is an index, or any comma-separated name of an entry: "jeep" is in "jeep, landrover". Case does not matter and
an underscore is a space. The whole entry counts as a name too. A name that is in several entries is refused with their
indices, an absent one with the nearest names, and an index that is another thing in another network.
"""

from collections.abc import Sequence

from patchproof.base.errors import Refused
from patchproof.base.validation import folded, spelling_hint


def find_labels(labels: Sequence[str], label: str | int, accept: Sequence[str | int] = ()) -> tuple[int, ...]:
    """Output indices of the target and of the labels accepted for it, the target first, none twice."""
    return tuple(dict.fromkeys(_find(labels, word) for word in (label, *accept)))


def refuse_different_entries(networks_labels: Sequence[Sequence[str]], label: str | int) -> None:
    """Refuse an index whose entries have no name in common with the first network's: they are different things."""
    if isinstance(label, int) and networks_labels:
        first, *others = (labels[label] for labels in networks_labels)
        if other := next((entry for entry in others if not _names(entry) & _names(first)), None):
            got = f'{label}, which is "{first}" in one of them and "{other}" in another'
            raise Refused("a label that is one thing in all networks", got, "give its name")


def _names(entry: str) -> set[str]:
    return {folded(name) for name in (entry, *entry.split(","))}


def _find(labels: Sequence[str], label: str | int) -> int:
    if isinstance(label, int):
        if not 0 <= label < len(labels):
            raise Refused(f"a label index from 0 to {len(labels) - 1}", str(label), "use one of those, or a name")
        return label
    matches = [i for i, entry in enumerate(labels) if folded(label) in _names(entry)]
    if len(matches) == 1:
        return matches[0]
    if matches:
        do = "use the index " + " or ".join(f'{i} ("{labels[i]}")' for i in matches)
        raise Refused("a label that names one class", f'"{label}", which is in {len(matches)} labels', do)
    raise Refused("a label that the network knows", f'"{label}"', nearest_hint(labels, label))


def nearest_hint(labels: Sequence[str], label: str) -> str:
    """Return advice with the labels nearest to a word."""
    names = list(dict.fromkeys(name.strip() for entry in labels for name in entry.split(",")))
    shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    otherwise = f"use an index below {len(labels)} or one of its {len(labels)} labels ({shown})"
    return spelling_hint(label, names, otherwise, most=3)
