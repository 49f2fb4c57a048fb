"""The command `idesplat`: its sub-commands, --config, and what all of them have."""

import shutil
import tomllib
from pathlib import Path

import pytest
from conftest import run_command
from idesplat import __version__
from idesplat.runtime.cli.application import COMMANDS
from idesplat.runtime.cli.launch import idesplat
from scene_files import write_scene
from typer.testing import CliRunner

ROOT = Path(__file__).parent.parent.parent.parent
# options, and the letters that stand for them wherever they exist
SHORT = {"images": "i", "cameras": "c", "out": "o", "model": "m", "verbose": "v", "quiet": "q"}


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(Path("scene.ply"))
    return tmp_path


def test_scripts_are_the_command_and_two_that_stay():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert set(scripts) == {"idesplat", "idesplat-export", "idesplat-infer"}


def test_version(capsys):
    assert run_command(idesplat, "--version") == 0
    assert capsys.readouterr().out == f"idesplat {__version__}\n"


def test_an_unknown_command_is_one_line(capsys):
    assert run_command(idesplat, "rendr") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: No such command 'rendr'. Did you mean 'render'; ") and error.count("\n") == 1


def commands():
    """Every command of the group with its parameters, groups of commands opened."""
    import typer
    from idesplat.runtime.cli.application import app

    group = typer.main.get_command(app)
    context = group.make_context("idesplat", [], resilient_parsing=True)
    for name in COMMANDS:
        _, command, _ = group.resolve_command(context, [name])
        for word, inner in getattr(command, "commands", {"": command}).items():
            yield f"{name} {word}".strip(), inner


def test_options_have_the_same_letters_everywhere():
    for name, command in commands():
        options = {opt[2:]: parameter.opts for parameter in command.params for opt in parameter.opts if opt[:2] == "--"}
        assert {"config", "quiet", "verbose"} <= set(options), name
        for option, letter in SHORT.items():
            assert option not in options or f"-{letter}" in options[option], (name, option)


def test_options_that_several_commands_have_mean_the_same():
    """By their help texts; what is named here means something else for each command."""
    own = {"--out", "--views", "--size", "--cameras", "--json", "--precision", "--preset", "--scenes", "--verbose"}
    own |= {"--depth", "--render", "--threads", "--focal", "--steps", "--seed", "--device"}
    texts: dict[str, set[str]] = {}
    for _, command in commands():
        for parameter in command.params:
            for option in set(parameter.opts) - own:
                if option.startswith("--"):
                    texts.setdefault(option, set()).add(parameter.help)
    assert [option for option, found in texts.items() if len(found) > 1] == []


@pytest.mark.parametrize("letters", ["-h", "--help"])
def test_help_is_of_the_sub_command(letters, capsys):
    assert run_command(idesplat, "convert", letters) == 0
    assert "Convert a splat file to the format" in capsys.readouterr().out


def test_completion_lists_sub_commands():
    from idesplat.runtime.cli.application import app

    environment = {"_IDESPLAT_COMPLETE": "complete_bash", "COMP_WORDS": "idesplat co", "COMP_CWORD": "1"}
    done = CliRunner().invoke(app, [], prog_name="idesplat", env=environment)
    assert done.output.split() == ["convert"]


# ---- --config


def test_config_gives_options_and_the_command_line_goes_before_it(workplace, capsys):
    Path("a.toml").write_text('min-opacity = 0.95\nout = "a.splat"\n')
    assert run_command(idesplat, "convert", "scene.ply", "--config", "a.toml") == 2
    assert "--min-opacity 0.95: no Gaussian is left" in capsys.readouterr().err
    assert run_command(idesplat, "convert", "scene.ply", "--config", "a.toml", "--min-opacity", "0.5") == 0
    assert Path("a.splat").exists()
    assert run_command(idesplat, "convert", "scene.ply", "b.splat", "--config", "a.toml", "--min-opacity", "0") == 0
    assert Path("b.splat").exists()


def test_quiet_leaves_out_notes(workplace, capsys):
    Path("a.toml").write_text("quiet = true\n")
    assert run_command(idesplat, "convert", "scene.ply", "a.splat", "--min-opacity", "0.5") == 0
    noted = capsys.readouterr().out.splitlines()
    assert run_command(idesplat, "convert", "scene.ply", "a.splat", "--min-opacity", "0.5", "--config", "a.toml") == 0
    assert capsys.readouterr().out.splitlines() == noted[-1:] and len(noted) > 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("veiws = 3", "idesplat convert has no option veiws; it has min-opacity"),
        ("min-opacity = [1]", "min-opacity is [1], expected a text or a number"),
        ("overwrite = 1", "overwrite is 1, expected true or false"),
        ("[convert]\nquiet = true", "has no option convert"),
        ("min-opacity", "a.toml: is no TOML"),
    ],
)
def test_a_wrong_config_is_one_line(workplace, capsys, content, said):
    Path("a.toml").write_text(content)
    assert run_command(idesplat, "convert", "scene.ply", "out.splat", "--config", "a.toml") == 2
    error = capsys.readouterr().err.replace("command convert", "idesplat convert")
    assert said in error and error.count("\n") == 1
    assert not Path("out.splat").exists()


def test_config_gives_lists(workplace, scene, capsys):
    shutil.copytree(scene / "images", "images")
    shutil.copy(scene / "transforms.json", ".")
    Path("a.toml").write_text('images = ["images"]\ncameras = "transforms.json"\nout = "c.json"\n')
    assert run_command(idesplat, "cameras", "convert", "--config", "a.toml") == 0
    assert "wrote c.json" in capsys.readouterr().out


def test_a_range_is_no_number(workplace, capsys):
    assert run_command(idesplat, "render", "scene.ply", "--orbit", "--frames", "0-1", "--out", "out") == 2
    assert "'--frames': 0-1 is no whole number" in capsys.readouterr().err


def test_the_library_logs_what_it_decides_and_prints_nothing_otherwise(workplace, scene, capsys):
    for verbose, logged in (((), False), (("-v",), True)):
        assert run_command(idesplat, "cameras", "convert", str(scene / "transforms.json"), "c.json", *verbose) == 0
        assert ("INFO idesplat.runtime.cameras.io: " in capsys.readouterr().err) == logged


def test_verbose_logs_to_stderr(workplace, capsys):
    assert run_command(idesplat, "convert", "scene.ply", "a.splat", "-vv") == 0
    printed = capsys.readouterr()
    assert "DEBUG idesplat.runtime." in printed.err and "wrote a.splat" in printed.out
