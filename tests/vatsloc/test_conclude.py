"""Where a run says that the nodule is, how sure it is, when it refuses to answer, and what it warns of, by value."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.collapse import PoroStatus, Theta
from poro.fit import FitStatus
from registration.volume import Mask
from tests.vatsloc import run_scene as known
from vatsloc.errors import NotConverged
from vatsloc.workflow.hilum import HilumSource
from vatsloc.workflow.localization import Localization, locate_nodule
from vatsloc.workflow.settings import settings_of
from vatsloc.workflow.stages import Stages

NO_RESIDUAL = "Too little lung is seen in both CBCTs"


def concluded(scene: known.Scene, log: Stages | None = None, **limits: float) -> Localization:
    settings = settings_of("balanced", {"gates": limits})
    return locate_nodule(scene.case, scene.prepared, scene.pose, scene.collapse, settings, log or Stages())


def spread() -> tuple[Any, Any]:
    """Semi-axes of the nodule's ellipsoid, longest first, and their directions in rows."""
    placed = known.DEF_FROM_INF_RIGID(known.NODULE_INF[None])
    values, vectors = np.linalg.eigh(known.modelled(placed, 4.0)[0])
    return np.sqrt(7.814728 * values[::-1]), vectors.T[::-1]


def test_the_nodule_goes_through_both_phases() -> None:
    found = concluded(known.scene())
    assert_allclose(found.nodule_inf, known.NODULE_INF)
    assert_allclose(found.nodule_def, known.NODULE_DEF)
    assert found.prepared is known.scene().prepared
    assert found.pose is known.scene().pose
    assert found.collapse is known.scene().collapse


def test_maps_to_the_deflated_image_agree_with_the_lung_and_beyond_it_with_the_spine() -> None:
    found = concluded(known.scene())
    for mapping, start, rigid in (
        (found.def_from_ct, known.NODULE_CT, known.DEF_FROM_CT_RIGID),
        (found.def_from_inf, known.NODULE_INF, known.DEF_FROM_INF_RIGID),
    ):
        assert_allclose(mapping(start[None])[0], known.NODULE_DEF)
        assert_allclose(mapping.around.matrix, rigid.matrix, atol=1e-12)


def test_the_ellipsoid_is_that_of_the_nodule_where_the_spine_places_it() -> None:
    lengths, directions = spread()
    found = concluded(known.scene())
    assert np.diff(lengths).max() < -0.5
    assert_allclose(found.ellipsoid_mm, lengths)
    assert_allclose(np.abs(np.einsum("ai,ai->a", found.ellipsoid_axes, directions)), 1.0)


def test_the_longest_semi_axis_is_held_against_its_limit() -> None:
    longest = spread()[0][0]
    for limit, ok in ((longest + 1e-6, True), (longest - 1e-6, False)):
        gate = concluded(known.scene(), max_ellipsoid_mm=limit).gates["ellipsoid"]
        assert gate.value == pytest.approx(longest)
        assert gate.limit == limit
        assert gate.ok is ok
        assert "too uncertain for a wedge resection" in gate.says


def views(inflated_mm: float, deflated_mm: float) -> known.Scene:
    """The known run where each image shows one voxel, so far from its own nodule."""
    scene = known.scene()

    def one_voxel(nodule: Any, out_mm: float) -> Mask:
        affine = np.eye(4)
        affine[:3, 3] = np.add(nodule, [0, 0, out_mm])
        return Mask(np.ones((1, 1, 1), bool), affine)

    prepared = replace(
        scene.prepared,
        inflated=known.cbct(known.INFLATED_GRID, one_voxel(known.NODULE_INF, inflated_mm), 1.0),
        deflated=known.cbct(known.DEFLATED_GRID, one_voxel(known.NODULE_DEF, deflated_mm), 2.0),
    )
    return replace(scene, prepared=prepared)


@pytest.mark.parametrize(("inflated_mm", "deflated_mm"), [(6.0, 0.0), (0.0, 6.0), (6.0, 3.0), (3.0, 6.0)])
def test_each_image_is_asked_for_its_own_nodule(inflated_mm: float, deflated_mm: float) -> None:
    for limit, ok in ((6.01, True), (5.99, False)):
        log = Stages()
        gate = concluded(views(inflated_mm, deflated_mm), log, max_out_of_view_mm=limit).gates["nodule_in_view"]
        assert gate.value == pytest.approx(6.0)
        assert gate.limit == limit
        assert gate.ok is ok
        for image, out_mm in (("inflated", inflated_mm), ("deflated", deflated_mm)):
            said = any(f"lies {out_mm:.0f} mm out of what the {image} CBCT shows" in w for w in log.warnings)
            assert said is (out_mm > 0)


def test_every_gate_is_there_and_one_that_fails_marks_the_result() -> None:
    fair = {"min_surface_points": 5, "max_fissure_share": 0.5, "max_folded_share": 0.1, "max_ellipsoid_mm": 100.0}
    found = concluded(known.scene(), **fair)
    assert {"overlap", "surface", "spine_ct_inflated", "ellipsoid", "nodule_in_view"} <= set(found.gates)
    assert found.status == "done"
    assert concluded(known.scene(), **fair | {"min_surface_points": 6}).status == "gate failed"


@pytest.mark.parametrize("fit_status", FitStatus)
@pytest.mark.parametrize("forward", PoroStatus)
def test_a_contact_that_did_not_settle_has_no_answer(fit_status: FitStatus, forward: PoroStatus) -> None:
    state = replace(known.scene().collapse.fit.state, status=forward)
    scene = known.scene().with_fit(status=fit_status, state=state)
    if fit_status is FitStatus.CONTACT or forward is PoroStatus.NOT_CONVERGED:
        with pytest.raises(NotConverged, match="contact of the collapsing lung did not settle"):
            concluded(scene)
    else:
        assert_allclose(concluded(scene).nodule_def, known.NODULE_DEF)


def warnings_of(scene: known.Scene, log: Stages | None = None) -> list[str]:
    log = log or Stages()
    concluded(scene, log)
    return log.warnings


def complete() -> known.Scene:
    """The known run with nothing to warn of."""
    return known.scene().with_collapse(residual=known.corrected(known.scene().pose.mesh_ct))


def test_a_run_with_nothing_wrong_warns_of_nothing() -> None:
    assert warnings_of(complete()) == []


@pytest.mark.parametrize(
    ("source", "warned"),
    [
        (HilumSource.AIRWAYS, False),
        (HilumSource.OFF, False),
        (HilumSource.SHIFT, True),
        (HilumSource.STILL, True),
    ],
)
def test_a_hilum_that_was_not_followed_is_warned_of(source: HilumSource, warned: bool) -> None:
    motion = replace(known.scene().collapse.observed.motion, source=source)
    expected = [f"The hilum's motion comes from {source.value}."] if warned else []
    assert warnings_of(complete().with_observed(motion=motion)) == expected


def test_a_missing_residual_registration_is_warned_of_unless_it_was_left_out() -> None:
    (warning,) = warnings_of(known.scene())
    assert warning.startswith(NO_RESIDUAL)
    log = Stages()
    log.skip("residual registration", "switched off")
    assert warnings_of(known.scene(), log) == []
    log = Stages()
    log.skip("extrapolation", "not needed")
    assert len(warnings_of(known.scene(), log)) == 1


def test_a_lung_that_did_not_collapse_is_warned_of() -> None:
    found: Any = SimpleNamespace(is_collapsed=False)
    (warning,) = warnings_of(complete().with_observed(found=found))
    assert "hardly any pleural air" in warning


def test_a_fit_that_ended_early_is_warned_of() -> None:
    (warning,) = warnings_of(complete().with_fit(status=FitStatus.STOPPED))
    assert warning == f"The fit ended early: {FitStatus.STOPPED.value}."


@pytest.mark.parametrize(
    ("theta", "named"),
    [
        (Theta(1e-4, 0.7, 11.0), "log10 kappa_b"),
        (Theta(2e-8, 0.93, 11.0), "phi"),
        (Theta(2e-8, 0.7, 0.0), "d_diaph_mm"),
        (Theta(2e-8, 0.93, 40.0), "phi and d_diaph_mm"),
    ],
)
def test_a_parameter_at_its_bound_is_named(theta: Theta, named: str) -> None:
    (warning,) = warnings_of(complete().with_fit(theta=theta))
    assert warning.startswith(f"The fit ended at a bound of {named}:")


def test_nodes_behind_the_wall_are_counted() -> None:
    state = replace(known.scene().collapse.fit.state, conflicts=3)
    (warning,) = warnings_of(complete().with_fit(state=state))
    assert warning.startswith("3 nodes were pushed behind the chest wall")
