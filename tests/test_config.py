"""Settings: invalid values, unknown and removed names, presets, methods, dictionaries."""

from __future__ import annotations

import json
import math
from dataclasses import fields

import pytest

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.config import METHODS, PRESETS, Config, DenseConfig, KeypointsConfig, VerifiedConfig

INF = math.inf
CLUSTERING = ("connectivity", "max_extent", "labeling")


@pytest.mark.parametrize(
    "method, field, value, allowed",
    [
        ("dense", "clustering", "kmeans", "one of 'components', 'hdbscan'"),
        ("dense", "connectivity", 6, "one of 4, 8"),
        ("dense", "connectivity", True, "one of 4, 8"),
        ("dense", "num_history", -1, "a whole number of at least 0"),
        ("dense", "max_extent", math.nan, "a number above 0"),
        ("dense", "max_extent", "20", "a number above 0"),
        ("dense", "max_speed", 10**400, "a number above 0, or None"),
        ("dense", "sweep_interval", INF, "a number of at least 1e-06 and of at most 1e"),
        ("dense", "sectional_view", "no", "True or False"),
        ("dense", "min_cluster_size", 1, "a whole number of at least 2"),
        ("keypoints", "patch_size", 53, "a whole number of at least 1 and of at most 51"),
        ("keypoints", "patch_size", 10, "an odd number"),
        ("keypoints", "ratio_threshold", 0.9, "a number of at least 1 and of at most 2"),
        ("verified", "significance", 1001, "a number of at least 0 and of at most 1000"),
        ("verified", "min_height", 0.0, "a number above 0 and of at most 1000, or None"),
        ("verified", "pixel_sizes", (0.25, 0.1), "whole multiples"),
        ("verified", "pixel_sizes", (1e308, 1e-5), "whole multiples"),
    ],
)
def test_invalid_values_are_refused_and_the_allowed_ones_named(method, field, value, allowed):
    with pytest.raises(CFlowError) as caught:
        METHODS[method](**{field: value})
    assert str(caught.value).startswith(f"{field}={value!r}"[:12]) and allowed in str(caught.value)
    with pytest.raises(CFlowError, match=field):
        Config.of({"method": method, field: value})


SPACE = {
    "pixel_sizes": [(), 0.1, "fine", (0.0,), (-0.1,), (math.nan,), (INF,), (0.1, 0.2), (0.2, 0.2), None],
    "point_cloud_range": [
        *(35, None, (-35, -35, 35, 35), (35, -35, -3, -35, 35, 3)),
        *((-35, math.nan, -3, 35, 35, 3), (-INF, -35, -3, 35, 35, 3)),
    ],
    "ego_box": [(1, 2, 3), (1.0, 0.0, 0.0, 1.0), (-INF, -1, 1, 1), (math.nan, -1, 1, 1), 3],
}


@pytest.mark.parametrize("field", SPACE)
def test_invalid_pixels_regions_and_boxes_are_refused(field):
    for value in SPACE[field]:
        with pytest.raises(CFlowError, match=f"{field}.*give"):
            DenseConfig(**{field: value})


def test_an_unknown_setting_lists_the_fields():
    message = r"unknown setting voxel_size \(did you mean pixel_sizes\?\): the fields are method, pixel_sizes,"
    for call in (make_config, VerifiedConfig().replace):
        with pytest.raises(CFlowError, match=message) as caught:
            call(voxel_size=0.1)
        assert all(f.name in str(caught.value) for f in fields(VerifiedConfig))


def test_a_setting_of_another_method_names_that_method():
    for preset, name, owners in (
        ("keypoints", "num_history", "dense and verified"),
        ("paper", "significance", "verified"),
        ("default", "patch_size", "keypoints"),
        ("default", "clustering", "dense"),
        *((preset, name, "dense and keypoints") for preset in ("default", "offline", "live") for name in CLUSTERING),
    ):
        with pytest.raises(CFlowError, match=f"{name} is a setting of method {owners}, not of"):
            make_config(preset, **{name: 1})


def test_presets_and_methods():
    methods = {**dict.fromkeys(("default", "offline", "live"), VerifiedConfig), "paper": DenseConfig}
    methods.update(keypoints=KeypointsConfig, paper_keypoints=KeypointsConfig)
    assert {name: type(make_config(name)) for name in PRESETS} == methods
    assert make_config() == make_config("default")
    assert make_config("paper") == DenseConfig()
    assert make_config("keypoints") != make_config("paper_keypoints") == KeypointsConfig()
    for name in PRESETS:
        config = make_config(name, max_speed=2.0)
        assert config.max_speed == 2.0 and make_model(config).config == config
        assert config.method == make_model(name).method
        assert make_config(config, max_speed=None) == make_config(name, max_speed=None)
    with pytest.raises(CFlowError, match="preset='best': give one of 'default', 'offline', 'live', 'paper'"):
        make_config("best")
    with pytest.raises(CFlowError, match="there is no method=: preset= says the method, too: give one of 'default'"):
        make_config(method="dense")


def test_presets_have_the_paper_s_base_row_and_documented_changes():
    paper, default = make_config("paper"), make_config("default")
    assert (paper.pixel_sizes, paper.num_history, paper.sectional_view) == ((0.1,), 0, False)
    assert paper.point_cloud_range == (-35.0, -35.0, -INF, 35.0, 35.0, INF) and paper.max_speed is None
    assert (default.pixel_sizes, default.num_history) == ((0.4, 0.2, 0.1), 4)
    assert make_config("offline") == default.replace(num_future=4) and make_config("offline").num_sweeps == 10
    near = make_config("keypoints").point_cloud_range
    assert make_config("live") == default.replace(num_compared=2, point_cloud_range=near) and near[:2] == (-51.2, -51.2)
    assert make_config(pixel_size=0.2).pixel_sizes == (0.2,)
    with pytest.raises(CFlowError, match="give one of them"):
        make_config(pixel_size=0.2, pixel_sizes=(0.4,))


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_a_dictionary(preset):
    config = make_config(preset, point_cloud_range=(-1, -2, -3, 1, 2, 3), ego_box=(-1, -1, 1, 1), max_speed=None)
    plain = json.loads(json.dumps(config.as_dict()))
    assert list(plain) == [f.name for f in fields(config)] and plain["method"] == config.method
    assert Config.of(plain) == config
    assert Config.of({"method": config.method}) == METHODS[config.method]()
    for wrong in ({}, {"method": "sparse"}, {**plain, "voxel_size": 1}, {**plain, "max_speed": -1}):
        with pytest.raises(CFlowError, match="give|the fields are"):
            Config.of(wrong)


@pytest.mark.parametrize("kind", METHODS.values())
def test_python_38_can_evaluate_the_types_of_the_settings(kind: type) -> None:
    """Hydra evaluates them: Python 3.8 has neither tuple[float, ...] nor float | None."""
    for each in kind.__mro__[:-1]:
        for name, annotation in each.__annotations__.items():
            assert "|" not in annotation and "tuple[" not in annotation, f"{each.__name__}.{name}: {annotation}"
