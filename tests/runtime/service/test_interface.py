"""The description of the service's interface says what the service takes."""

import json
import typing

from idesplat.runtime.batch.scenes import OPTIONS
from idesplat.runtime.service.fields import FIELDS
from idesplat.runtime.service.schema import EXAMPLE, Scene, request_body


def test_every_option_is_a_field():
    assert set(FIELDS) == set(OPTIONS)


def test_examples_are_taken():
    for name, field in FIELDS.items():
        text = str(field.example).lower() if isinstance(field.example, bool) else str(field.example)
        value = OPTIONS[name](text)
        kinds = {"boolean": bool, "number": float, "integer": int}
        assert isinstance(value, kinds.get(field.kind, object)), name
        for choice in field.choices:
            OPTIONS[name](choice)
    assert Scene(**EXAMPLE).model_dump(mode="json") == EXAMPLE


def test_the_form_is_described_with_examples():
    form = request_body()["content"]["multipart/form-data"]
    properties = form["schema"]["properties"]
    assert set(properties) == {"images", "cameras", "save_depth", "render", *OPTIONS}
    for example in form["examples"].values():
        assert set(example["value"]) <= set(properties)
    json.dumps(form)
    assert typing.get_type_hints(Scene)["files"] == list[str]
