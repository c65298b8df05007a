"""The printed page: template, piece, color chart, PDF, manifest, and the way back from PDF to pixels.

In: a design as uint8 sRGB pixels, a template in millimeters, and the scene's settings. Out: SHEET.pdf at true size
and SHEET.json (the manifest), its exact geometry. Reading order: `template` (pages as data), `piece` (the design and
its markers), `chart`, `page` (one page, and the proof that nothing overlaps), `pdf` (ink), `write` (both files or
neither), `raster` (PDF to pixels). Everything is in millimeters, x right, y down; PDF points exist inside `pdf` and
`raster` alone. Needs no torch.
"""
