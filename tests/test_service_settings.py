"""Configuration: precedence, refusal of unknown keys, and where each value comes from."""

from pathlib import Path

import pytest

from daq.service.settings import ConfigError, explain, load


@pytest.fixture(autouse=True)
def _clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "none"))
    monkeypatch.delenv("ENTRAIN_CONFIG", raising=False)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_listen_on_loopback_without_keys() -> None:
    settings = load()
    assert settings.server.host == "127.0.0.1"
    assert not settings.needs_key


def test_environment_wins_over_file_and_options_over_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write(tmp_path / "a.toml", "[server]\nport = 9001\nhost = '10.0.0.1'\n")
    monkeypatch.setenv("ENTRAIN_SERVER__PORT", "9002")
    settings = load(file)
    assert (settings.server.port, settings.server.host) == (9002, "10.0.0.1")
    assert settings.needs_key
    assert load(file, server__port=9003).server.port == 9003


def test_explain_names_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write(tmp_path / "a.toml", "[server]\nhost = '127.0.0.1'\n[rigs.tube]\n")
    monkeypatch.setenv("ENTRAIN_LIVE__QUEUE", "99")
    sources = {origin.key: origin.source for origin in explain(file)}
    assert sources["server.host"] == f"file {file}"
    assert sources["live.queue"] == "environment ENTRAIN_LIVE__QUEUE"
    assert sources["server.port"] == "default"
    assert sources["rigs.tube.driver"] == "default"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[server]\nprot = 1\n", "server.prot"),
        ("sever = 1\n", "sever"),
        ("[server]\nport = 70000\n", "server.port=70000: "),
        ("[server]\nport = 'x'\n", "server.port='x': "),
        ("a = " + 5000 * "[", "nested too deeply"),
        ("[server]\ntls_key = 'a'\n", "tls_certificate"),
        ("[server\n", "TOML"),
    ],
)
def test_a_wrong_file_is_refused_by_key_and_file(tmp_path: Path, text: str, named: str) -> None:
    file = write(tmp_path / "a.toml", text)
    with pytest.raises(ConfigError, match=str(file)) as caught:
        load(file)
    assert named in str(caught.value)


@pytest.mark.parametrize("name", ["ENTRAIN_SERVR__PORT", "ENTRAIN_SERVER__PROT"])
def test_an_unknown_variable_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "1")
    with pytest.raises(ConfigError, match=name):
        load()


def test_a_wrong_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENTRAIN_SERVER__PORT", "many")
    with pytest.raises(ConfigError, match=r"environment ENTRAIN_SERVER__PORT: server\.port"):
        load()


def test_a_file_that_was_asked_for_must_exist(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        load(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="is no file"):
        load(tmp_path)
