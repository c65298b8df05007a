"""What the documents say of ONNX files by torch's exporters is what is stored."""

import json
import re
from pathlib import Path

RESULTS = Path(__file__).parents[2] / "src/patchlab/results"


def test_the_quoted_figures_are_the_stored_ones():
    networks = json.loads((RESULTS / "onnx/exporters.json").read_text())
    figures = [figure for exporters in networks.values() for figure in exporters.values()]
    gradients = sorted(figure["gradient_torch"] for figure in figures)
    logits = max(figure["logits_onnxruntime"] for figure in figures)
    alike = sum(gradient <= 1e-3 for gradient in gradients)
    in_float64 = max(figure.get("gradient_torch_float64", 0) for figure in figures)
    quoted = (
        rf"both of torch 2.13's exporters: {len(networks)} .* {len(figures)} of {len(figures)} read; logits within "
        rf"{logits}; gradients within 0.001 in {alike}, within {gradients[-1]} in the others, "
        rf"which meet kinks in float32 and are within {in_float64} in float64"
    )
    assert re.search(quoted, (RESULTS / "measured.md").read_text())
