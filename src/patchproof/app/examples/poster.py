"""A print that exists already, made elsewhere and without markers: its promise, and a verdict from photographs."""

import numpy as np

import patchproof as pp

colors = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)  # or the path of the print's picture
poster = colors.repeat(8, 0).repeat(8, 1)
run = pp.import_patch(poster, "box.toml", "poster-run", as_printed=(130, 130), promise=pp.PromiseOptions(views=40))
pp.sheet(run, "poster.json")  # no page: the print exists
pp.reprint("poster.json", run, 12, "poster-photos", sessions=4)
corners = pp.CaptureInfo(corners="poster-photos/corners.csv")  # the print's four corners, or find=True
report = pp.verify("poster-photos", "poster.json", "poster-report", capture=corners)
print(report.summary.verdict, report.summary.reason, report.summary.next_step)
