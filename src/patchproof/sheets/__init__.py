"""The printed page: template, piece, color chart, PDF, manifest, and the rendering of a PDF back to pixels.

In: a design as uint8 sRGB pixels, a template in millimeters, and the scene's settings. Out: SHEET.pdf at true size
and SHEET.json (the manifest) with its exact geometry. Reading order: `template` (pages as data), `piece` (the design
and its markers), `page` (one page, without overlaps; the chart), `pdf` (drawing), `write` (both files or neither),
`pdf_raster` (PDF to pixels). Everything is in millimeters, x right, y down; PDF points occur in `pdf` and `pdf_raster`
only. Needs no torch.
"""
