"""Settings: checked when made, unknown names refused, presets as documented."""

from __future__ import annotations

import json
import math
from dataclasses import FrozenInstanceError, fields

import pytest

from cflow_torch import CFlowError, Config, CorrelationFlow, CorrelationFlowKeypoints, make_config, make_model
from cflow_torch.checks import DENSE_ONLY, NOT_WITH_PROOF
from cflow_torch.config import PRESETS

INF = math.inf


@pytest.mark.parametrize(
    "field, value",
    [
        ("method", "sparse"),
        ("clustering", "kmeans"),
        ("labeling", "opencv"),
        ("labeling", None),
        ("correlation", "FFT"),
        ("densify", ""),
        ("connectivity", 6),
        ("connectivity", True),
        ("connectivity", "8"),
        ("pixel_sizes", ()),
        ("pixel_sizes", 0.1),
        ("pixel_sizes", "fine"),
        ("pixel_sizes", (0.0,)),
        ("pixel_sizes", (-0.1,)),
        ("pixel_sizes", (math.nan,)),
        ("pixel_sizes", (INF,)),
        ("pixel_sizes", (0.1, 0.2)),
        ("pixel_sizes", (0.2, 0.2)),
        ("point_cloud_range", 35),
        ("point_cloud_range", None),
        ("point_cloud_range", (-35, -35, 35, 35)),
        ("point_cloud_range", (35, -35, -3, -35, 35, 3)),
        ("point_cloud_range", (-35, -35, 3, 35, 35, 3)),
        ("point_cloud_range", (-35, math.nan, -3, 35, 35, 3)),
        ("point_cloud_range", (-INF, -35, -3, 35, 35, 3)),
        ("point_cloud_range", (-35, -35, -3, 35, INF, 3)),
        ("num_history", -1),
        ("num_history", 1.5),
        ("num_history", True),
        ("num_history", None),
        ("max_extent", 0),
        ("max_extent", -1.0),
        ("max_extent", math.nan),
        ("max_extent", "20"),
        ("max_speed", 0.0),
        ("max_speed", math.nan),
        ("max_speed", "fast"),
        ("max_object", 0),
        ("max_object", math.nan),
        ("max_object", "car"),
        ("max_object", True),
        ("zero_test", 0),
        ("zero_test", 0.001),
        ("zero_test", 1001),
        ("zero_test", math.nan),
        ("zero_test", "2"),
        ("subpixel", "gauss"),
        ("subpixel", None),
        ("height_slices", 1),
        ("height_slices", 9),
        ("height_slices", -2),
        ("height_slices", 4.0),
        ("slice_height", 0),
        ("slice_height", INF),
        ("sweep_interval", 0),
        ("sweep_interval", None),
        ("patch_size", 10),
        ("patch_size", 11.0),
        ("ratio_threshold", 0.9),
        ("ratio_threshold", math.nan),
        ("ratio_threshold", "big"),
        ("ratio_threshold", None),
        ("gate_radius", 0),
        ("gate_radius", float("inf")),
        ("sweep_interval", float("inf")),
        ("max_memory", 0),
        ("max_memory", "1GB"),
        ("sectional_view", "no"),
        ("sectional_view", None),
        ("use_timestamps", "false"),
    ],
)
def test_invalid_values_name_the_field(field, value):
    with pytest.raises(CFlowError, match=field):
        Config(**{field: value})
    with pytest.raises(CFlowError, match=field):
        make_config(**{field: value})


@pytest.mark.parametrize(
    "field, value",
    [("max_object", 25.0), ("zero_test", 1.5), ("subpixel", "parabola"), ("height_slices", 4), ("proof", True)],
)
def test_options_of_the_dense_method_are_refused_for_key_points(field, value):
    assert getattr(make_config("paper", **{field: value}), field) == value
    with pytest.raises(CFlowError, match=f"{field}.*dense"):
        make_config("keypoints", **{field: value})


def test_height_slices_need_components():
    with pytest.raises(CFlowError, match="height_slices.*components"):
        make_config("paper", height_slices=4, clustering="hdbscan")


def test_options_beyond_the_paper_are_off_for_the_paper_and_for_key_points():
    for name in ("paper", "keypoints"):
        assert {key: getattr(make_config(name), key) for key in DENSE_ONLY} == DENSE_ONLY


@pytest.mark.parametrize(
    "given",
    [
        {"clustering": "hdbscan"},
        {"sectional_view": True},
        {"zero_test": 1.5},
        {"subpixel": "parabola"},
        {"height_slices": 3},
        {"pixel_sizes": (0.25, 0.1)},
    ],
)
def test_what_does_not_go_with_the_proof_says_how_to_mend_it(given):
    (name,) = given
    proof = make_config("paper", proof=True, pixel_sizes=(0.4, 0.2, 0.1))
    with pytest.raises(CFlowError, match=f"{name}=.*proof=True.*give proof=False too, or start from preset='paper'"):
        proof.replace(**given)
    proof.replace(proof=False, **given)
    make_config("paper", **given)


def test_everything_that_does_not_go_with_the_proof_is_refused():
    others = {"clustering": "hdbscan", "sectional_view": True, "zero_test": 1.5, "subpixel": "parabola"}
    assert set(others) == set(NOT_WITH_PROOF)
    for name, value in others.items():
        with pytest.raises(CFlowError, match=name):
            make_config("paper", proof=True, **{name: value})


def test_unknown_field_lists_the_fields():
    for call in (make_config, Config().replace, lambda **kw: CorrelationFlow.from_preset("paper", **kw)):
        with pytest.raises(CFlowError, match="voxel_size") as caught:
            call(voxel_size=0.1)
        for field in fields(Config):
            assert field.name in str(caught.value)
        assert "pixel_size," in str(caught.value)


def test_unknown_preset_lists_the_presets():
    with pytest.raises(CFlowError, match="preset='best'") as caught:
        make_config("best")
    assert all(name in str(caught.value) for name in PRESETS)


def test_pixel_size_is_short_for_one_scale():
    assert make_config(pixel_size=0.2).pixel_sizes == (0.2,)
    assert make_config(pixel_sizes=[0.4, 0.2]).pixel_sizes == (0.4, 0.2)
    with pytest.raises(CFlowError, match="one of them"):
        make_config(pixel_size=0.2, pixel_sizes=(0.4,))
    with pytest.raises(CFlowError, match="pixel_size"):
        make_config(pixel_size=-1)


def test_the_paper_s_base_row():
    config = make_config("paper")
    assert config.method == "dense" and config.clustering == "components"
    assert config.pixel_sizes == (0.1,) and config.num_history == 0
    assert config.point_cloud_range == (-35.0, -35.0, -INF, 35.0, 35.0, INF)
    assert config.max_speed is None and not config.sectional_view


def test_every_preset_is_valid():
    for name in PRESETS:
        assert make_config(name, max_speed=2.0).max_speed == 2.0
        assert make_model(make_config(name)).config == make_config(name)
        assert not make_config(name, proof=False).proof  # which is all that must be said to do without
    assert CorrelationFlow.from_preset("fast").config == make_config("fast")
    assert CorrelationFlowKeypoints.from_preset().config == make_config("keypoints")


def test_config_cannot_be_changed_and_replace_makes_a_copy():
    config = Config()
    with pytest.raises(FrozenInstanceError):
        config.num_history = 3
    other = config.replace(num_history=3)
    assert (config.num_history, other.num_history) == (0, 3)
    assert hash(config) == hash(Config()) and config == Config() and config != other


def test_as_dict_goes_round():
    config = make_config("paper", pixel_sizes=(0.4, 0.1), point_cloud_range=(-1, -2, -3, 1, 2, 3), max_speed=20.0)
    plain = json.loads(json.dumps(config.as_dict()))
    assert list(plain) == [f.name for f in fields(Config)]
    assert make_config("paper", **plain) == config


def test_whole_numbers_become_floats():
    config = Config(pixel_sizes=[1], point_cloud_range=range(6))
    assert config.pixel_sizes == (1.0,) and isinstance(config.pixel_sizes[0], float)
    assert config.point_cloud_range == (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


def test_a_class_refuses_the_other_method():
    with pytest.raises(CFlowError, match="keypoints.*make_model"):
        CorrelationFlow.from_preset("paper", method="keypoints")
    with pytest.raises(CFlowError, match="dense.*make_model"):
        CorrelationFlowKeypoints(Config())
    assert type(make_model(make_config("paper", method="keypoints"))) is CorrelationFlowKeypoints


def test_pixel_sizes_whose_quotient_no_float_holds_are_refused():
    with pytest.raises(CFlowError, match="whole multiples"):
        make_config(pixel_sizes=(1e308, 0.2, 0.1))
