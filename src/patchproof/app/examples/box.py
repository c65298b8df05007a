"""A flat patch on a box: design, page, photographs, verdict. `draft=True` is a first look; a print deserves more."""

import patchproof as pp

scene = pp.load_scene("box.toml")
run = pp.optimize(scene, "box-run", draft=True)
pp.sheet(run, "box.pdf")
pp.reprint("box.pdf", run, 48, "box-photos", sessions=12)  # or your own photographs of the print, a folder a place
report = pp.verify("box-photos", "box.json", "box-report")
print(report.summary.verdict, report.summary.reason, report.summary.next_step)
