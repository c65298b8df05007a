"""Studies whose figures are not drawn, for tests of what stands beside them: drawing takes as long as a small study."""


def draw_nothing(monkeypatch) -> None:
    """Every figure of a study's page is the same few bytes."""
    monkeypatch.setattr("patchproof.report.tables.draw_figure", lambda *_, **__: b"not drawn")
