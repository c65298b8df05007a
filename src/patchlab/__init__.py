"""The laboratory: studies, charts and training runs that produce the figures which patchproof's documents quote.

In: configs and stored results in `results/`, and the tool, which it imports; the tool never imports it. Out: tables,
charts and pages of its command, `patchlab`. Left out on purpose: everything that a user with an object, a
printer and a camera needs; that is the tool.
"""
