"""Structure-aware multiple salient object detection for robot cells.

    import numpy as np
    import samsod

    cell = samsod.Cell()
    scene = cell.inspect(rgb)                  # uint8 (H, W, 3)
    for part in scene.objects:                 # without their shadows
        print(part.centroid, part.area, part.axis_deg)

    cell = samsod.Cell(catalogue=samsod.Catalogue("parts"), camera=samsod.Camera.from_file("camera.toml"))
    for found in cell.inspect(rgb).detections:
        print(found.name, found.x_mm, found.y_mm, found.yaw_deg)

Images are C-contiguous uint8 arrays of shape (H, W, 3) in RGB order and are read in place, without the interpreter
lock: do not write to them from another thread meanwhile. x points right and y down, pixel centres are at integers.
"""

from samsod._native import (
    FRINGE_SIGNS,
    PIECE_SIGNS,
    Camera,
    Catalogue,
    Cell,
    Detection,
    ObjectRegion,
    Part,
    Partition,
    Recognizer,
    SalientRegion,
    Scene,
    __version__,
    describe_fringe,
    describe_pieces,
    saliency,
    salient_regions,
    segment,
    separate_shadows,
    settle_objects,
)

__all__ = [
    "FRINGE_SIGNS",
    "PIECE_SIGNS",
    "Camera",
    "Catalogue",
    "Cell",
    "Detection",
    "ObjectRegion",
    "Part",
    "Partition",
    "Recognizer",
    "SalientRegion",
    "Scene",
    "__version__",
    "describe_fringe",
    "describe_pieces",
    "saliency",
    "salient_regions",
    "segment",
    "separate_shadows",
    "settle_objects",
]
