"""The laboratory: studies, benchmarks and training runs that produce the figures which patchproof's documents quote.

In: configs and stored results in `results/`, and the tool, which it imports; the tool never imports it. Out: tables,
charts and pages of its command, `patchlab`. Left out on purpose: whatever somebody needs who has an object, a printer
and a camera; that is the tool.
"""
