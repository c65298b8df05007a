"""Studies whose figures are not drawn, for tests of what stands beside them: drawing takes as long as a small study."""

from patchproof.report import page


def draw_nothing(monkeypatch) -> None:
    """Every figure of a study's page is the same few bytes."""
    monkeypatch.setattr("patchproof.report.tables.draw_figure", lambda *_, **__: b"not drawn")


def draw_once(monkeypatch) -> None:
    """The figure of a size in the page of the same data is drawn once."""
    draw_figure, drawn = page.draw_figure, {}

    def draw(figure, size_in, kind, **options):
        key = options["metadata"]["Comment"], size_in
        drawn[key] = drawn.get(key) or draw_figure(figure, size_in, kind, **options)
        return drawn[key]

    monkeypatch.setattr("patchproof.report.tables.draw_figure", draw)
