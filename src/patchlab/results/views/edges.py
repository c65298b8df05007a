"""Compare ways to draw outlines: the bare object with jagged and smooth outlines, beside 3×3 samples to a pixel.

In: scene files of `../promises`. Out: a line of `edges.csv` per scene: confidence less that of the samples, means over
the conditions with 95 % intervals (Student's). Run in this folder: python edges.py suv pickup light postbox mug carton
"""

import sys
from dataclasses import replace

import torch
from torch.nn.functional import avg_pool2d

import patchproof as pp
from patchlab.results.rows import write_rows
from patchproof.base.intervals import student_mean
from patchproof.channel.camera import develop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose, shade
from patchproof.render.views import render_views

N, SEED, SAMPLES = 60, 78, 3
NETWORK = "file:${PATCHPROOF_DATA}/models/mobilenet_v1_0.75_192.onnx"


def measured(name: str) -> dict:
    """The line of one scene."""
    problem = set_problem(pp.load_scene(f"../promises/{name}.toml"), models=[NETWORK])
    conditions, size_px = problem.scene.draw("evaluate", N, SEED), problem.scene.settings.camera.photo_px
    classifier, sure = problem.classifiers[0], []
    for one in (conditions[i : i + 1] for i in range(N)):
        with torch.no_grad():
            views = render_views(problem.stage, None, one, size_px)
            light = shade(render_views(problem.stage, None, one, tuple(SAMPLES * side for side in size_px)), None)
            pictures = [
                expose(replace(views, outlines=None), None, jpeg=False),
                expose(views, None, jpeg=False),
                develop(avg_pool2d(light, SAMPLES), one.sensor, 1.0, jpeg=False),
            ]
            sure.append(classifier.confidence(classifier.logits(torch.cat(pictures)), problem.indices[0]))
    jagged, smooth, samples = torch.stack(sure, 1).double().numpy()
    row = {"scene": name, "n": N, "confidence": samples.mean()}
    for kind, values in (("jagged", jagged), ("smooth", smooth)):
        off = student_mean(values - samples)
        row |= {f"{kind}_off": off.value, f"{kind}_low": off.low, f"{kind}_high": off.high}
    return {key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()}


if __name__ == "__main__":
    write_rows("edges.csv", (measured(name) for name in sys.argv[1:]))
