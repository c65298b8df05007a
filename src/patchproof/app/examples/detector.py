"""A patch for a detector, which boxes the object: recognized is a box of the target on it with a sufficient score."""

import patchproof as pp

scene = pp.load_scene("detector.toml")
run = pp.optimize(scene, "detector-run", draft=True)
pp.sheet(run, "detector.pdf")
pp.reprint("detector.pdf", run, 12, "detector-photos", sessions=4)
boxes = pp.CaptureInfo(boxes="detector-photos/coco.json")  # of the object: your own labels of your photographs
report = pp.verify("detector-photos", "detector.json", "detector-report", capture=boxes)
print(report.summary.verdict, report.summary.reason, report.summary.next_step)
