"""The fast simulated camera: edges where the lens puts them, noise that repeats, and a live source made of it."""

import numpy as np
import pytest

from astratag.camera import Camera
from astratag.detector import Detector
from astratag.dictionary import load_dictionary
from astratag.surface import Cylinder
from astratag.transforms import exp_so3, inverse, pose
from pipeline.convert import pose_matrix
from pipeline.mission import CylinderSection, MarkerSection, Mission
from pipeline.render import render_marker, srgb_from_linear
from pipeline.scenario import FACING, Approach
from pipeline.sim_camera import LightSection, SensorSection, SimCamera, SimCameraSection
from pipeline.sim_source import SimScenario, SimSource
from pipeline.sources import SourceError, open_source
from schemas import Truth
from schemas.topics import CALIBRATION, FRAME, TRUTH

CAMERA = SimCameraSection(focal_px=800.0, distortion=(-0.1, 0.05, 0.001, -0.001, 0.0)).camera()
SIDE_M = 0.1
PLAIN = SensorSection(blur_px=1.0, read_noise_e=0.0, full_well_e=1e9, vignetting=0.0)
EVEN = LightSection(brightness=1.0, panel_albedo=0.85, sky=0.85)


def seen(
    T: np.ndarray, *, surface=None, sensor: SensorSection = PLAIN, camera: Camera = CAMERA, **kwargs
) -> np.ndarray:
    marker = (
        MarkerSection(id=7, side_m=SIDE_M) if surface is None else MarkerSection(id=7, side_m=SIDE_M, surface=surface)
    )
    return SimCamera(camera, Mission(markers=(marker,)), light=EVEN, sensor=sensor, seed=1).picture(T, 5, **kwargs)


POSES = [
    pose(FACING @ exp_so3(np.array(tilt)), p)
    for tilt, p in (
        ((0.2, -0.3, 0.4), (0.01, 0.02, 0.9)),
        ((0.0, 0.0, 0.0), (0.1, -0.05, 0.5)),
        ((-0.3, 0.2, 1.0), (0.0, 0.0, 0.25)),
        ((0.1, 0.1, 0.0), (0.0, 0.01, 0.12)),
    )
]


@pytest.mark.parametrize("T", POSES)
@pytest.mark.parametrize("surface", [None, CylinderSection(radius_m=0.15)])
def test_the_detector_measures_the_true_pose(T: np.ndarray, surface: CylinderSection | None):
    """As well as a single frame tells it: near and far, flat and bent, cut off by the picture's edge or not."""
    bent = None if surface is None else Cylinder(surface.radius_m, surface.axis_rad)
    found = Detector(side_m=SIDE_M, surface=bent).detect(seen(T, surface=surface), CAMERA)
    assert [detection.marker_id for detection in found] == [7]
    assert found[0].T_cam_marker is not None
    error_m = np.linalg.norm(found[0].T_cam_marker[:3, 3] - T[:3, 3])
    assert error_m < 5e-3 * T[2, 3]


@pytest.mark.parametrize("T", POSES)
def test_against_the_exact_renderer(T: np.ndarray):
    """Within a grey level of the ray caster's picture on average, and a few levels on the steepest edges."""
    signature = load_dictionary("astratag20").signature(7)
    white = float(srgb_from_linear(np.float32(EVEN.sky)) * 255)
    exact = render_marker(
        CAMERA, T, signature=signature, side_m=SIDE_M, blur_px=1.0, noise_sigma=0, background=white, samples=64
    ).astype(float)
    fast = seen(T, sensor=PLAIN.model_copy(update={"rays": 28}))
    assert np.abs(fast - exact).mean() < 1.0
    assert np.percentile(np.abs(fast - exact), 99.9) < 6


def test_the_same_instant_looks_the_same_and_another_does_not():
    sensor = SensorSection()
    camera = SimCamera(CAMERA, Mission(markers=(MarkerSection(id=7),)), light=LightSection(), sensor=sensor, seed=1)
    one, again, later = (camera.picture(POSES[0], t_ns) for t_ns in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert np.any(one != later)


def test_glare_leaves_nothing_to_see_and_a_marker_behind_is_not_seen():
    assert seen(POSES[0], glare=1.0).min() == 255
    assert np.ptp(seen(pose(np.eye(3), (0.0, 0.0, -1.0)))) == 0


def test_a_simulated_source_gives_truth_and_frames_without_end_of_its_memory():
    scenario = SimScenario(
        approach=Approach(duration_s=4.0, end_m=0.8), camera=SimCameraSection(focal_px=800.0, rate_hz=5.0)
    )
    envelopes = list(SimSource(scenario, paced=False).envelopes())
    topics = [e.topic for e in envelopes]
    assert topics == [CALIBRATION, *([TRUTH, FRAME] * 21)]
    truth = envelopes[1].message()
    assert isinstance(truth, Truth)
    T_cam_target = inverse(scenario.mission.camera.T_chaser_cam.matrix()) @ pose_matrix(truth.T_chaser_target)
    np.testing.assert_allclose(T_cam_target, scenario.approach.at(0.0).T_a_b, atol=1e-9)


def test_sim_is_a_source_by_name(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text("camera: {rate_hz: 7}\nseed: 3\n")
    source = open_source(f"sim:{path}")
    assert source.live
    assert not source.closed_loop
    with pytest.raises(ValueError, match="cannot read scenario"):
        open_source("sim:nowhere.yaml")
    with pytest.raises(SourceError, match="--camera cannot be given here"):
        open_source("sim", camera=tmp_path / "camera.yaml")
    path.write_text("light: {brightness: -1}\n")
    with pytest.raises(ValueError, match=r"light\.brightness"):
        open_source(f"sim:{path}")
