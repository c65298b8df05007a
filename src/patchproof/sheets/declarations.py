"""List what sheets' PDFs can declare, and what `sheets.pdf_raster` does with it."""

from patchproof.base.declarations import Declaration

DECLARED: tuple[Declaration, ...] = (
    Declaration("PDF", "attached manifest", "used", "checked as sheet.json; of several designs that of the run"),
    Declaration("PDF", "pages", "used", "those that the manifest names; no other is looked at"),
    Declaration("PDF", "MediaBox", "used", "millimeters are counted from its top-left corner"),
    Declaration("PDF", "CropBox other than the MediaBox", "refused", "the sheet would be of another size"),
    Declaration("PDF", "Rotate", "refused", "markers would lie elsewhere than the manifest says"),
    Declaration("PDF", "UserUnit", "refused", "lengths would not be those of the manifest"),
    Declaration("PDF", "a password", "refused", "it cannot be read"),
)
