"""Measures samsod's vision chain against scenes whose truth is known.

``python -m samsod.evaluation cell DIR`` is the command; `samsod.evaluation.metrics` holds the measures themselves as
pure functions on arrays. Needs the extra ``samsod[evaluation]`` (Pillow and scipy).
"""
