"""Older versions of the scene document, brought up to the present one as they are read.

| version | what changed |
|---|---|
| 1 | the first |
| 2 | history: ``remarks`` became ``notes``; images: ``sattools:tone_match`` became ``sattools:radiometric_balance`` |
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sattools.scene.jsonio import JsonObject

FORMAT_VERSION = 2
READABLE = (1, FORMAT_VERSION)
_ENTRY = {"remarks": "notes", "witnessed_by_two": "consistent_in_two"}
_PROPERTY = {"sattools:tone_match": "sattools:radiometric_balance"}


def upgraded(document: Mapping[str, Any]) -> JsonObject:
    """A document of a readable version as one of the present version; what is damaged is left for others to report.

    Args:
        document: with a `sattools` member of one of the versions `READABLE`.
    """
    ours = dict(document["sattools"])
    if ours["version"] == FORMAT_VERSION:
        return dict(document)
    ours["version"] = FORMAT_VERSION
    if isinstance(ours.get("history"), list):
        ours["history"] = [_renamed(entry, _ENTRY) for entry in ours["history"]]
    features = document.get("features")
    if isinstance(features, list):
        features = [_upgraded_feature(feature) for feature in features]
    return {**document, "sattools": ours, "features": features}


def _upgraded_feature(feature: Any) -> Any:
    if not isinstance(feature, Mapping) or not isinstance(feature.get("properties"), Mapping):
        return feature
    return {**feature, "properties": _renamed(feature["properties"], _PROPERTY)}


def _renamed(members: Any, names: Mapping[str, str]) -> Any:
    """The members under their present names, in their order."""
    if not isinstance(members, Mapping):
        return members
    return {names.get(name, name): value for name, value in members.items()}


__all__ = ["FORMAT_VERSION", "READABLE", "upgraded"]
