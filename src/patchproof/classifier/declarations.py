"""What files of networks can declare, and what load_classifier does with each declaration."""

from patchproof.base.declared import Declaration

DECLARED: tuple[Declaration, ...] = (
    Declaration("ONNX", "opset", "used", "7 to 28 of the standard domain; others are refused"),
    Declaration("ONNX", "attributes of operators", "used", "as onnxruntime does"),
    Declaration("ONNX", "attributes that contradict each other or the weights", "refused", "such as auto_pad and pads"),
    Declaration("ONNX", "fields and attributes that are not known", "refused", "names, comments and hints apart"),
    Declaration("ONNX", "operators of other domains, functions, subgraphs", "refused", "the operators below; If, Loop"),
    Declaration("ONNX", "training mode and steps", "refused", "of BatchNormalization, Dropout, the model"),
    Declaration("ONNX", "sparse or quantized tensors", "refused", "also QuantizeLinear and its kind"),
    Declaration("ONNX", "location, offset, length of weights", "used", "of files in the same folder"),
    Declaration("ONNX", "location outside of the folder", "refused", "also by a link"),
    Declaration("ONNX", "checksum of weights", "used", "SHA-1, compared"),
    Declaration("ONNX", "default value of an input", "used", "as a constant"),
    Declaration("ONNX", "number of pictures", "used", "called with that number"),
    Declaration("ONNX", "type and dimensions of the input", "refused", "other than float32, N×3×S×S, N×S×S×3"),
    Declaration("ONNX", "pictures of N×S×S×3", "used", "as TensorFlow and Keras write them"),
    Declaration("ONNX", "several outputs", "refused", "of a classifier; those of a detector are its head's"),
    Declaration("ONNX", "metadata: preparation of pictures", "refused", "other than sRGB in [0, 1]: BGR, mean, range"),
    Declaration("ONNX", "metadata: other entries", "said", "such as Ultralytics' names, imgsz, task"),
    Declaration("NAME.json", "input_px", "used", "the square's side; refused if the network takes another"),
    Declaration("NAME.json", "labels", "used", "by the order of outputs; refused if their number differs"),
    Declaration("NAME.json", "kind", "used", "classifier or detector"),
    Declaration("NAME.json", "head", "used", "how a detector's outputs become boxes and scores"),
    Declaration("NAME.json", "mean, std, channels, range", "refused", "other than sRGB in [0, 1] and no normalization"),
    Declaration("NAME.json", "resize, crop, interpolation, activation", "said", "all is seen; other keys are notes"),
    Declaration("safetensors", "names and shapes", "refused", "other than the network's own"),
    Declaration("safetensors", "whole numbers as weights", "refused", "quantized weights"),
    Declaration("safetensors", "format", "refused", "other than pt: weights in another order"),
    Declaration("safetensors", "other metadata", "said", "left aside"),
    Declaration("outputs", "probabilities, percent, 8 bits", "refused", "in place of logits, a detector's too"),
    Declaration(
        "outputs", "of known labels, unlike those of a known network", "said", "with the change that fits better"
    ),
    Declaration("outputs", "values from 0 to 1 that may be logits", "said", "from an untrained network, say"),
    Declaration("outputs", "candidates of another shape", "refused", "than N×A×(4+K) or a usual head's"),
    Declaration("outputs", "those of a detector's head that is not told", "said", "read by shapes and values"),
    Declaration("outputs", "boxes in 0 to 1, (center, size), reversed", "refused", "not left, top, right, bottom"),
    Declaration("outputs", "boxes (top, left, bottom, right)", "said", "if they run down columns"),
    Declaration("outputs", "boxes of pictures of another size", "said", "if they lie outside, or on one side"),
)
