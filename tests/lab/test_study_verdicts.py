"""The study of verdicts: chances add up, the rule's own limits hold, and sessions help."""

from patchlab.study.study import run_study


def test_chances_of_verdicts(tmp_path):
    (tmp_path / "s.toml").write_text("correlations = [0.1]\nsessions = [1, 4]\npromises = 4\n")
    finished = run_study("verdicts", tmp_path / "s.toml", tmp_path / "out")
    rows = {(row[1], row[2]): row[3:] for row in finished.tables[0].rows}
    assert all(abs(sum(row) - 1) < 1e-6 for row in rows.values())
    assert rows[1, 0.85][0] < rows[4, 0.85][0] and rows[4, 0.65][0] < 0.05 < rows[4, 0.75][0]
    assert rows[4, 0.85][2] < 0.06 < rows[4, 0.65][2]
    assert (tmp_path / "out" / "verdicts_kept.png").is_file()
