"""List what pictures can declare, and what `photo.read` does with it; the tests hold a file for each entry."""

from __future__ import annotations

from patchproof.base.declared import Declaration

_ANY = "any picture"
DECLARED: tuple[Declaration, ...] = (
    Declaration(_ANY, "orientation in EXIF", "used", "once, also where the library turns the pixels itself"),
    Declaration(_ANY, "orientation in XMP", "used", "where EXIF has none"),
    Declaration(_ANY, "orientations in EXIF and XMP that differ", "said", "EXIF's is used"),
    Declaration("TIFF", "orientation (tag 274)", "used", "the library turns the pixels"),
    Declaration("AVIF, HEIC", "irot and imir", "used", "by the library"),
    Declaration(_ANY, "ICC profile of RGB", "used", "palette, gray and transparent pictures, too; by what it does"),
    Declaration(_ANY, "ICC profile of gray", "used", "in gray pictures, with alpha, too"),
    Declaration("JPEG, TIFF", "ICC profile of CMYK", "used", "in pictures of these inks"),
    Declaration(
        _ANY, "ICC profile named sRGB that is another", "used", "sRGB is what moves no color by more than 1/255"
    ),
    Declaration(_ANY, "ICC profile that is broken, or of another kind of picture", "said", "read as sRGB"),
    Declaration("JPEG, TIFF", "CMYK without a profile", "said", "RGB is an estimate"),
    Declaration("TIFF", "CIELAB", "used", "in 8 bits"),
    Declaration(_ANY, "Adobe RGB in EXIF", "used", "interoperability R03, or ColorSpace 2"),
    Declaration(_ANY, "Adobe RGB (R03) beside sRGB in EXIF", "said", "read as sRGB"),
    Declaration(_ANY, "ColorSpace 65535 in EXIF without R03 or a profile", "said", "read as sRGB"),
    Declaration(_ANY, "primaries, white and gamma in EXIF or TIFF (tags 318, 319)", "used", "without profile or R03"),
    Declaration("PNG", "cICP", "used", "before iCCP, sRGB, cHRM and gAMA"),
    Declaration("PNG", "sRGB", "used", "before cHRM and gAMA"),
    Declaration("PNG", "cHRM and gAMA", "used", "as a power of the codes"),
    Declaration("PNG", "cHRM or gAMA that no screen has", "said", "read as sRGB"),
    Declaration("PNG, AVIF, HEIC", "PQ or HLG (cICP, nclx)", "refused", "unreadable: save it as JPEG in sRGB"),
    Declaration("AVIF, HEIC", "nclx", "used", "where there is no profile"),
    Declaration("BMP", "a calibrated or embedded color space", "said", "read as sRGB"),
    Declaration("JPEG", "RGB without JFIF or Adobe's marker", "used", "by the names of its components"),
    Declaration("JPEG", "Adobe's marker: inverted CMYK and YCCK", "used", "by the library"),
    Declaration("JPEG", "CMYK without Adobe's marker", "used", "as it is stored, not inverted"),
    Declaration("JPEG, HEIC", "gain map", "said", "the base picture is used"),
    Declaration("PNG, TIFF", "16 bits a channel", "used", "rounded to 8 bits after gamma, before a profile"),
    Declaration("TIFF", "12 bits in 12, or 10 to 14 in 16 by MaxSampleValue", "used", "white is the declared maximum"),
    Declaration("PNG, TIFF", "16 bits of which the upper 2 or more are never used", "said", "read as dark as stored"),
    Declaration("TIFF", "floating-point values of one channel", "said", "linear light from 0 to 1"),
    Declaration("TIFF", "floating-point RGB, or 64 bits", "refused", "unreadable: save it as JPEG or PNG"),
    Declaration("TIFF", "WhiteIsZero", "used", "also in 16 bits"),
    Declaration("TIFF", "associated alpha (ExtraSamples 1)", "used", "divided out, on white"),
    Declaration("TIFF", "other extra channels (ExtraSamples 0)", "said", "left out"),
    Declaration("PNG, GIF, WebP", "transparency", "used", "on white"),
    Declaration("TIFF, GIF, APNG, WebP, MPO", "pages after the first", "said", "the first is read"),
    Declaration("MPO", "previews (large thumbnails)", "used", "left out: they show what the picture shows"),
    Declaration("JPEG", "damaged or missing parts", "refused", "unreadable: copy it again; within one block: unseen"),
    Declaration("PNG, TIFF, WebP, GIF", "an end that is missing", "refused", "unreadable: copy it again"),
    Declaration(_ANY, "35 mm focal length in EXIF", "used", "unless EXIF shows a crop, another size or a digital zoom"),
    Declaration(_ANY, "resolution (dpi)", "said", "of scans where it is not --scan-dpi; photographs have none"),
)
