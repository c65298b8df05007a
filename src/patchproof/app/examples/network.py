"""Your own network, mesh and loss: the gradient of a photograph in the design, then design, page and verdict."""

import torch
import trimesh

import patchproof as pp

net = torch.nn.Sequential(torch.nn.AvgPool2d(32), torch.nn.Flatten(), torch.nn.Linear(3, 2, bias=False))
net[2].weight.data = torch.tensor([[-8.0, 8, 0], [8, -8, 0]])  # N×3×32×32 → N×2: greener than red, or not
network = pp.classifier_of(net, 32, ["green", "other"])
loss = lambda logits, indices: -logits[:, indices[0]]  # noqa: E731  # yours, in place of the goal's: N×2 → N

settings = {
    "object": {"mesh": trimesh.creation.box((3, 2, 2)), "length_mm": 300},
    "patch": {"width_mm": 90, "height_mm": 90},
    "target": {"label": "green", "models": [network]},
    "camera": {"photo_px": [800, 600]},
    "optimize": {"steps": 8},
}
scene = pp.make_scene(settings)
stage, views = pp.set_stage(scene), scene.draw("evaluate", 2)
design, nudge = torch.full((3, 16, 16), 0.5, requires_grad=True), torch.zeros(3, 16, 16)
nudge[1] = 0.02  # all of green: one pixel moves the loss by as little as float32 rounds


def total_loss(shown):
    """The sum of the losses over the views, differentiable in the design 3×h×w."""
    return loss(network.logits(pp.photograph(stage, shown, views, (96, 96), jpeg=False)), [0]).sum()


(gradient,) = torch.autograd.grad(total_loss(design), design)
difference = (total_loss(design + nudge) - total_loss(design - nudge)) / 0.04
print(f"gradient {gradient[1].sum():.5f}, by finite differences {difference:.5f}")

run = pp.optimize(scene, "network-run", loss=loss)
pp.sheet(run, "network.pdf")
pp.reprint("network.pdf", run, 6, "network-photos", sessions=3)
report = pp.verify("network-photos", "network.json", "network-report", models=[network])
print(report.summary.verdict, report.summary.reason, report.summary.next_step)
