"""Experiments: what the paper measured, measured on a scene of one's own. Each is a module of this package.

An experiment has ``TITLE``, ``SOURCE`` (the paper's table), ``measure(scene, options) -> document`` and
``draw(figure, document)``; ``run.py`` runs it and writes JSON, a table and a plot.
"""
