"""The paper's evaluation of saliency (section 6.1, appendices A.2 and A.3) on any folder of images and masks.

    python -m samsod.evaluation saliency --images DIR --masks DIR [--maps METHOD=DIR ..] --out DIR

`metrics` has the measures as functions of arrays; `pairs` finds the files of an image and names what is wrong with
them; `methods` makes or reads the maps; `scoring` measures one image, `running` all of them; `tables`, `figures` and
`command` write what came of it.
"""
