"""Any network as `photo -> logits`: load.py lists the model names, network.py defines a classifier."""

from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier, center_square

__all__ = ["Classifier", "center_square", "find_labels", "load_classifier"]
