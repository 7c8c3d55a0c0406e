"""A phrase is its English text, and whatever happens to it on the way it can be said in another language."""

from __future__ import annotations

import json
import pickle
import re
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from phrases.phrase import Phrase, join, phrases_in, restore, say

words = st.text(max_size=8)
plain = words.map(lambda text: text.replace("{", "{{").replace("}", "}}"))


@st.composite
def phrases(draw: st.DrawFn, depth: int = 2) -> Phrase:
    values: dict[str, Any] = {}
    template = draw(plain)
    for number in range(draw(st.integers(0, 3))):
        inner = phrases(depth=depth - 1) if depth else words
        values[f"v{number}"] = draw(st.one_of(words, inner))
        template += f"{{v{number}}}" + draw(plain)
    return Phrase(template, **values)


def test_a_message_is_its_english_text() -> None:
    made = Phrase("slopes of {slope_deg:.0f}° are {how}", slope_deg=33.3, how=Phrase("hard"))
    assert made == "slopes of 33° are hard"
    assert made.template == "slopes of {slope_deg}° are {how}"
    assert made.plain()["values"] == {"slope_deg": "33", "how": {"template": "hard", "values": {}}}
    assert isinstance(str(ValueError(made)), Phrase)


@given(phrases())
def test_it_survives_a_pickle_and_is_told_once_more_from_its_parts(made: Phrase) -> None:
    again = pickle.loads(pickle.dumps(made))
    assert (again, again.template, again.values) == (made, made.template, made.values)
    told = json.loads(json.dumps({"a": [made], "phrases": phrases_in({"a": [made]})}))
    assert say(restore(told, told["phrases"]), {}) == {"a": [made]}
    assert phrases_in(restore(told["a"], told["phrases"])) == told["phrases"]


@given(phrases())
def test_it_is_changed_in_all_its_parts(made: Phrase) -> None:
    def hide(text: str) -> str:
        return re.sub(r"[^v0-9{}]", "?", text)

    hidden = made.map(hide)
    assert say(restore([hidden], phrases_in([hidden])), {}) == [hidden] == [hide(made)]


@given(st.lists(phrases(depth=0), max_size=4), words)
def test_joined_messages_read_as_their_texts_do(parts: list[Phrase], separator: str) -> None:
    assert join(separator, parts) == separator.join(parts)


def test_another_language_may_say_the_values_in_another_order() -> None:
    made = Phrase("{count} of {whole} lines, {how}", count=3, whole=7, how=Phrase("slowly"))
    table = {"{count} of {whole} lines, {how}": "{how}: {whole} Zeilen, davon {count}", "slowly": "langsam"}
    assert say(restore([made, "3"], phrases_in(made)), table) == ["langsam: 7 Zeilen, davon 3", "3"]
