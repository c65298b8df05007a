"""What COCO JSON with the object's boxes can declare, and what `annotations` does with it."""

from patchproof.base.declarations import Declaration

_FILE, _CORNERS = "COCO JSON", "COCO JSON (corners)"
DECLARED: tuple[Declaration, ...] = (
    Declaration(_FILE, "`width`, `height`", "used", "boxes are scaled from a copy to the photograph"),
    Declaration(_FILE, "size of the photograph as stored, which EXIF turns", "used", "the box is turned along"),
    Declaration(_FILE, "size of another shape than the photograph's", "refused", "it is another picture"),
    Declaration(_FILE, "no `width` or `height`", "refused", "COCO asks for them"),
    Declaration(_FILE, "`bbox` outside of the picture, or below a pixel", "refused", "corners and shares are named"),
    Declaration(_FILE, "`attributes.rotation` of a box", "refused", "boxes are upright"),
    Declaration(_FILE, "`iscrowd`", "refused", "one object is judged"),
    Declaration(_FILE, "several boxes of an image", "refused", "one object is judged"),
    Declaration(_FILE, "`segmentation`", "said", "its box counts"),
    Declaration(_FILE, "`category_id`", "used", "of the target's label, or the only one; others are other things"),
    Declaration(_FILE, "`file_name` in folders, also with backslashes", "used", "or its last part, if it is unique"),
    Declaration(_FILE, "`file_name` or `id` of an image twice", "refused", "boxes could not be told apart"),
    Declaration(_CORNERS, "`keypoints`, or a `segmentation` of four points", "used", "others are refused"),
    Declaration(_CORNERS, "`width`, `height`", "used", "of the upright picture or a copy; another shape is refused"),
)
