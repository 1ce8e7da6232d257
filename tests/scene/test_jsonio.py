"""Text, JSON and TOML that anybody may have written."""

import json
from pathlib import Path
from typing import Any

import pytest

from sattools.errors import InputError
from sattools.scene.jsonio import CONFIG_LIMIT, decode, parse_json, read_bytes, read_json, read_text, read_toml

DEEP = 100_000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * DEEP, "nested too deeply"),
        ('{"a":' * DEEP, "nested too deeply"),
        ("[" * 200 + "]" * 200, "nested too deeply"),
        ("9" * 5000, "thousands of digits"),
        ("[" + "9" * 400 + "]", "a number of .* bits"),
        ('"\\ud800"', "lone surrogate"),
        ('{"\\udfff": 1}', "lone surrogate"),
        ("{", "not JSON"),
        ("", "not JSON"),
        ("\0", "not JSON"),
    ],
)
def test_json_that_would_break_what_comes_after_it_is_refused(text: Any, words: Any) -> None:
    with pytest.raises(InputError, match=words) as caught:
        parse_json(text, "x.json")
    assert str(caught.value).startswith("x.json: found ")
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * DEEP, "a = " + "9" * 5000, "a = " + "9" * 400, "a.b" * DEEP, "a = ", "\0", "[a]\n[a]"],
)
def test_toml_that_would_break_what_comes_after_it_is_refused(tmp_path: Path, text: Any) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_toml(path)
    assert str(caught.value).startswith(f"{path}: found ")


def test_ordinary_documents_are_read_whatever_their_byte_order_mark(tmp_path: Path) -> None:
    document = {"a": [1, 2.5, None, True, {"b": "Zürich 東京 😀"}], "n": 2**63}
    text = json.dumps(document, ensure_ascii=False)
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-32"):
        path = tmp_path / f"{encoding}.json"
        path.write_bytes(text.encode(encoding))
        assert read_json(path) == document
    (tmp_path / "x.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "x.toml") == {"a": 1}


def test_vendors_text_may_be_latin_but_documents_may_not(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_bytes(b"stra\xdfe\r\n")
    assert read_text(path, strict=False) == "straße\n"
    with pytest.raises(InputError, match=r"not UTF-8 \(byte"):
        read_text(path)
    with pytest.raises(InputError, match="not UTF-16"):
        decode(b"\xff\xfe\x00", "x")


def test_what_never_ends_is_read_to_its_limit_only(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="more than 1 MiB"):
        read_bytes("/dev/zero", CONFIG_LIMIT)
    large = tmp_path / "large"
    large.write_bytes(b" " * 11)
    assert read_bytes(large, 11) == b" " * 11
    with pytest.raises(InputError, match="found more than"):
        read_bytes(large, 10)


@pytest.mark.parametrize("name", [".", "none", "x" * 300, "a\0b"])
def test_what_is_no_file_is_named(tmp_path: Path, name: Any) -> None:
    with pytest.raises(InputError, match="expected a readable file"):
        read_bytes(f"{tmp_path}/{name}")


def test_a_json_value_that_is_no_object_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text("[1]")
    with pytest.raises(InputError, match="found a JSON list, expected a JSON object"):
        read_json(path)
