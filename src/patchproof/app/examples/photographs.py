"""Your photographs of the object with a blank sheet on it, in place of a mesh."""

import numpy as np

import patchproof as pp

# Simulated here: with a camera, print `patchproof sheet --template blank_a4 --out blank.pdf`, fix it on the object and
# copy six or more sharp photographs into blank-photos.
world = pp.import_patch(np.full((64, 64, 3), 255, np.uint8), "box.toml", "world", promise=pp.PromiseOptions(views=8))
pp.sheet(world, "blank.pdf", control="blank")
pp.reprint("blank.pdf", world, 6, "blank-photos")

run = pp.optimize("photographs.toml", "photographs-run", draft=True)
pp.sheet(run, "photographs.pdf")
pp.reprint("photographs.pdf", run, 48, "print-photos", sessions=12)
report = pp.verify("print-photos", "photographs.json", "photographs-report")
print(report.summary.verdict, report.summary.reason, report.summary.next_step)
