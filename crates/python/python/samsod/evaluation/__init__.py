"""Measures samsod's vision chain against scenes whose truth is known.

``python -m samsod.evaluation cell DIR`` is the command. `samsod.evaluation.metrics` and `samsod.evaluation.objects`
hold the measures themselves as pure functions on arrays, `samsod.evaluation.summary` says what `summary.json` holds.
Needs the extra ``samsod[evaluation]`` (Pillow, scipy, matplotlib and tqdm).
"""
