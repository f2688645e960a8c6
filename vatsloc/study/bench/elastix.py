"""itk-elastix as a peer: the paper's B-spline registration from a given pose. Ref: Klein 2010; Alvarez 2021, 6.1."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from registration.maps.field import DisplacementField
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.frames import flip_affine, flip_field
from vatsloc.workflow.stages import Stages

THREADS = 2


@dataclass(frozen=True)
class ElastixSettings:
    """What `run_elastix` asks of elastix: finest B-spline grid in mm, which doubles per coarser level; levels;
    iterations per level; samples per iteration."""

    grid_mm: float = 16.0
    levels: int = 5
    iterations: int = 500
    samples: int = 10_000


@dataclass(frozen=True)
class ElastixRun:
    """moving_from_fixed: the field found; seconds and peak_mb: of the registration alone, images in memory."""

    moving_from_fixed: DisplacementField
    seconds: float
    peak_mb: float


def elastix_version() -> str | None:
    """Version of the installed itk-elastix; None where there is none."""
    try:
        return version("itk-elastix")
    except PackageNotFoundError:
        return None


def run_elastix(fixed: Volume, moving: Volume, fixed_mask: Mask, settings: ElastixSettings) -> ElastixRun:
    """Register `moving` to `fixed` with the metric inside `fixed_mask`, starting from where both lie. Needs itk."""
    import itk

    parameters = itk.ParameterObject.New()
    chosen = parameters.GetDefaultParameterMap("bspline", settings.levels, settings.grid_mm)
    chosen["Registration"] = ["MultiResolutionRegistration"]
    chosen["Metric"] = ["AdvancedNormalizedCorrelation"]
    chosen["MaximumNumberOfIterations"] = [str(settings.iterations)]
    chosen["NumberOfSpatialSamples"] = [str(settings.samples)]
    # Its own schedule grows by 1.41 per level: 64 mm at the coarsest, from which whole lungs are caught less often.
    chosen["GridSpacingSchedule"] = [str(2**level) for level in reversed(range(settings.levels))]
    for pyramid in ("FixedImagePyramid", "MovingImagePyramid"):
        chosen[pyramid] = [pyramid.replace("Image", "RecursiveImage")]  # coarse levels are sampled coarsely too
    chosen["ErodeMask"] = ["false"]  # eroded masks leave next to nothing at the coarse levels
    chosen["WriteResultImage"] = ["false"]
    parameters.AddParameterMap(chosen)
    images = _image(fixed.hu, fixed.grid, np.float32), _image(moving.hu, moving.grid, np.float32)
    mask = _image(fixed_mask.inside, fixed_mask.grid, np.uint8)
    stages = Stages()
    with stages.stage("elastix"):
        run = itk.ElastixRegistrationMethod.New(*images)
        run.SetParameterObject(parameters)
        run.SetFixedMask(mask)
        run.SetLogToConsole(False)
        run.SetNumberOfThreads(THREADS)
        run.UpdateLargestPossibleRegion()
    with TemporaryDirectory() as scratch:  # it writes the field to a file as well
        field = itk.transformix_deformation_field(
            images[1], run.GetTransformParameterObject(), output_directory=scratch
        )
    vectors = np.moveaxis(itk.array_from_image(field), (2, 1, 0), (0, 1, 2))
    found = DisplacementField(np.ascontiguousarray(flip_field(vectors)), fixed.ras_from_ijk)
    return ElastixRun(found, stages.seconds["elastix"], stages.peak_mb["elastix"])


def _image(values: Array, grid: Grid, kind: type) -> Any:
    import itk

    image = itk.image_from_array(np.ascontiguousarray(values.T, dtype=kind))
    lps_from_ijk = flip_affine(grid.ras_from_ijk)
    image.SetSpacing(grid.spacing.tolist())
    image.SetOrigin(lps_from_ijk[:3, 3].tolist())
    image.SetDirection(itk.matrix_from_array(lps_from_ijk[:3, :3] / grid.spacing))
    return image
