"""Any network as `photo -> logits`; see load.py for the names and network.py for what a classifier is."""

from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier, center_square

__all__ = ["Classifier", "center_square", "find_labels", "load_classifier"]
