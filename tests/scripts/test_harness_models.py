"""The models of OpenSceneFlow's configuration in the package are those of the presets."""

from __future__ import annotations

from typing import Any


def test_the_models_in_the_package_are_those_of_the_presets(script: Any) -> None:
    written = script(".", "harness_models")
    committed = {file.name: file.read_text(encoding="utf-8") for file in written.FOLDER.glob("*.yaml")}
    assert committed == written.models()
