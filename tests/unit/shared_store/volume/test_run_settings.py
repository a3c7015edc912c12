"""Comparing settings: which may not change, and the first that does."""

from __future__ import annotations

from types import SimpleNamespace

from shared_store.volume.run_settings import first_difference, fixed_settings, innermost, merged, setting_at

KIND = SimpleNamespace(fixed=("sizes", "net.depth", "rate"), clone_may_change=("rate",))


def test_a_dot_and_changes_reach_into_sections_and_an_empty_section_is_none_or_replaces_one() -> None:
    settings = {"net": {"depth": 3, "more": {}}, "sizes": [8]}
    assert setting_at(settings, "net.depth") == 3 and setting_at(settings, "sizes") == [8]
    assert setting_at(settings, "net.more") is None and setting_at(settings, "sizes.depth") is None
    assert setting_at(None, "a") is None
    trained = {"rewards": {"alive": 1.0, "fall": -1.0}, "curriculum": {"level": [[0, 0.0]]}, "angle": 1.0}
    changes = {"rewards": {"alive": 2.0}, "curriculum": {}, "angle": {"new": 1}}
    assert merged(trained, changes) == {"rewards": {"alive": 2.0, "fall": -1.0}, "curriculum": {}, "angle": {"new": 1}}
    assert trained["rewards"] == {"alive": 1.0, "fall": -1.0}


def test_the_first_difference_is_reported_with_both_values_also_inside_of_sections() -> None:
    old, new = {"sizes": [8], "net": {"depth": 3}}, {"sizes": [8], "net": {"depth": 0}, "rate": {}}
    assert first_difference(old, new, KIND.fixed) == ("net.depth", 3, 0)
    assert first_difference(old, new, ("sizes", "rate")) is None
    old = {"class_name": "RNNModel", "rnn": {"type": "gru", "size": 64}}
    new = {"class_name": "RNNModel", "rnn": {"type": "gru", "size": 32}}
    assert innermost("actor", old, new) == ("actor.rnn.size", 64, 32)
    assert innermost("actor", {"a": 1}, {"a": 1, "b": 2}) == ("actor.b", None, 2)
    assert innermost("actor", None, {"a": 1}) == ("actor", None, {"a": 1})


def test_fixed_settings_are_those_of_the_class_that_the_checkpoint_has() -> None:
    assert fixed_settings(KIND) == ["sizes", "net.depth", "rate"] and fixed_settings(None) == []
    assert fixed_settings(KIND, of_clone=True) == ["sizes", "net.depth"]
    assert fixed_settings(KIND, {"net": None}, of_clone=True) == ["net.depth"]
