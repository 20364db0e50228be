from __future__ import annotations

import tomllib
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geofleet.config import SECTIONS, load_config, packaged_scenarios
from geofleet.errors import ConfigError


@pytest.mark.parametrize("name", sorted(packaged_scenarios()))
def test_every_packaged_scenario_loads(name):
    assert load_config(name).scenario == name


def test_paper_names_every_key_so_that_defaults_live_in_one_place():
    tree = tomllib.loads(packaged_scenarios()["paper"].read_text())
    assert {name: set(keys) for name, keys in tree.items()} == {
        name: set(section.model_fields) for name, section in SECTIONS.items()
    }


def test_key_names_are_unique_over_sections():
    names = [key for section in SECTIONS.values() for key in section.model_fields]
    assert len(names) == len(set(names))


def test_overrides_with_and_without_section():
    assert load_config("paper", ["range_m=50"]) == load_config("paper", {"sensor.range_m": 50})
    assert load_config("paper", ["tracker=ideal"]).tracking.tracker == "ideal"


def test_a_file_starts_from_paper(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[sensor]\nrange_m = 80.0\n")
    config = load_config(path)
    assert (config.scenario, config.sensor.range_m) == ("mine", 80.0)
    assert config.tracking == load_config("paper").tracking


def test_a_number_given_for_a_core_is_the_rule_everywhere(tmp_path):
    """Whoever asks for DBSCAN at 3 means scikit-learn's; the default follows the place."""
    assert load_config().aggregate.min_samples_share > 0
    assert load_config("paper", ["min_samples=3"]).aggregate.min_samples_share == 0
    assert load_config("paper", {"aggregate.min_samples": 5}).aggregate.min_samples_share == 0
    assert load_config("paper", ["min_samples=3", "min_samples_share=0.7"]).aggregate.min_samples_share == 0.7
    path = tmp_path / "mine.toml"
    path.write_text("[aggregate]\nmin_samples = 4\n")
    assert (load_config(path).aggregate.min_samples, load_config(path).aggregate.min_samples_share) == (4, 0.0)
    path.write_text("[aggregate]\nmin_samples = 4\nmin_samples_share = 0.6\n")
    assert load_config(path).aggregate.min_samples_share == 0.6


def test_digest_changes_with_what_it_covers_only():
    paper, wide = load_config(), load_config("paper", ["eps_m=5.0"])
    assert paper.digest("sensor") == wide.digest("sensor")
    assert paper.digest("aggregate") != wide.digest("aggregate")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["rang_m=3"], r"unknown scenario key 'rang_m'\. Did you mean range_m"),
        (["sensor.eps_m=3"], "unknown scenario key 'sensor.eps_m'"),
        (["fov_deg=400"], r"sensor\.fov_deg: .*less than or equal to 360 \(got 400\)"),
        (["gnss_sigma_m=-1"], r"sensor\.gnss_sigma_m"),
        (["gnss_sigma_m=nan"], r"sensor\.gnss_sigma_m"),
        (["false_negative_rate=1.2"], r"sensor\.false_negative_rate"),
        (["tracker=magic"], r"tracking\.tracker"),
        (["groups=[]"], r"scene\.groups: .*at least 1"),
        (["range_m=1e9"], r"sensor\.range_m: .*less than or equal to 10000"),
        (["frame_spacing_m=1e-9"], r"fleet\.frame_spacing_m: .*greater than or equal to 0\.01"),
        (["send_information=maybe"], r"^tracking\.send_information: [^;]* true, false or auto \(got 'maybe'\)\. Corr"),
        (["nothing"], "'nothing' is not key=value"),
    ],
)
def test_bad_overrides_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        load_config("paper", overrides)


def test_a_bad_value_is_blamed_on_the_option_or_the_file_that_gives_it(tmp_path):
    for key in ("fov_deg=400", "send_information=maybe", "mixed.rtk.range_m=-1"):
        with pytest.raises(ConfigError) as given:
            load_config("paper", [key, "mixed.rtk.share=0.1"])
        assert "paper.toml" not in str(given.value)
        assert str(given.value).endswith("Correct the option.")
    with pytest.raises(
        ConfigError, match=r"^the shares of \[mixed\] add up to 1\.4, more than the whole fleet\. Correct"
    ):
        load_config("paper", ["mixed.a.share=0.7", "mixed.b.share=0.7"])
    path = tmp_path / "mine.toml"
    path.write_text("[sensor]\nfov_deg = 400\n")
    for options in ([], ["range_m=-1"]):
        with pytest.raises(
            ConfigError, match=r"mine\.toml: sensor.*fov_deg: .*Correct the value in the file or the option"
        ):
            load_config(path, options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sensors]\nrange_m = 1", "unknown section or key 'sensors'"),
        ("range_m = 1", "unknown section or key 'range_m'"),
        ("[sensor]\nrange = 1", r"mine\.toml: unknown scenario key 'sensor\.range'"),
        ("[sensor", r"mine\.toml: not valid TOML"),
        ("base = 'nowhere'", "unknown scenario 'nowhere'"),
    ],
)
def test_bad_files_are_named(text, message, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(path)


def test_files_that_start_from_each_other_are_refused(tmp_path):
    a, b = tmp_path / "a.toml", tmp_path / "b.toml"
    a.write_text(f"base = '{b}'")
    b.write_text("base = 'a.toml'")
    with pytest.raises(ConfigError, match="start from each other: a -> b -> a"):
        load_config(a)


@given(st.text(max_size=30))
def test_no_override_text_is_a_traceback(text):
    with suppress(ConfigError):
        load_config("paper", [text])
