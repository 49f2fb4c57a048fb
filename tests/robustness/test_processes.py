"""The commands as processes: whose code they run, what they leave behind, and how they end."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DEFAULT_SIGNALS
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.splats.formats.ply import write_ply
from idesplat.runtime.splats.gaussians import with_colours
from idesplat.runtime.system.files import atomic_write, scratch_folder
from idesplat.tools.evaluation.novel_views import Result, Target
from idesplat.tools.evaluation.report import print_views

COLUMNS = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
COLUMNS += ("rot_0", "rot_1", "rot_2", "rot_3")
MODEL = {  # of COLMAP, as its documentation writes it
    "cameras.txt": "1 PINHOLE 640 480 500 500 320 240\n",
    "images.txt": "1 1 0 0 0 0 0 1 1 a.png\n\n2 1 0 0 0 1 0 1 1 b.png\n\n",
    "points3D.txt": "",
}
# Modules that commands and their helper processes import, from Python, from others and of ours.
TRAPS = ("json", "numpy", "pycolmap", "resource", "multiprocessing", "pickle", "typing", "onnxruntime", "idesplat")


def call(module: str, *arguments: object, **options) -> subprocess.CompletedProcess:
    """Run the command of a module in a process of its own."""
    command = [sys.executable, "-P", "-c", f"from {module} import main; main()", *map(str, arguments)]
    settings = {"capture_output": True, "text": True, "timeout": 300, **options}
    return subprocess.run(command, **settings)


def set_traps(folder: Path) -> Path:
    """Fill a folder with modules that leave a file when they are imported; the file."""
    sprung = folder / "sprung"
    for name in TRAPS:
        code = f"open({str(sprung)!r}, 'a').write({name!r})\n"
        (folder / f"{name}.py").write_text(code)
    (folder / "idesplat").mkdir()
    (folder / "idesplat" / "__init__.py").write_text(code)
    return sprung


def write_scene(path: Path) -> Path:
    rng = np.random.default_rng(0)
    means, quats = rng.normal(size=(50, 3)), np.tile([1.0, 0, 0, 0], (50, 1))
    write_ply(path, with_colours(means, np.full((50, 3), 0.1), quats, np.full(50, 0.8), rng.random((50, 3))))
    return path


# ---- whose code runs


def test_no_code_of_a_folder_of_cameras_runs(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    for name, text in MODEL.items():
        (model / name).write_text(text)
    sprung = set_traps(tmp_path)
    script = Path(sys.executable).with_name("idesplat")  # as users call it
    done = subprocess.run([script, "cameras", "convert", ".", "out.json"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "read 2 cameras as colmap" in done.stdout
    assert not sprung.exists()


@pytest.mark.slow
def test_no_code_of_the_current_folder_runs_in_benchmarks(tmp_path):
    sprung = set_traps(tmp_path)
    code = (
        "from idesplat.tools.benchmark.worker import Worker, describe\n"
        "if __name__ == '__main__':\n"
        f"    with Worker(describe, __import__('pathlib').Path({str(bundled_model())!r})) as worker:\n"
        "        print(worker.about['preset'])\n"
    )
    script = tmp_path.parent / f"{tmp_path.name}.py"
    script.write_text(code)
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.stdout == "idesplat-lite\n", done.stderr
    assert not sprung.exists()


TRAINING = """
from pathlib import Path

from idesplat.tools.training.parallel import spawn_workers

def work(group):
    Path("worked").touch()

if __name__ == "__main__":
    with spawn_workers(2, work):
        pass
"""


@pytest.mark.slow
def test_no_code_of_the_current_folder_runs_in_training(tmp_path):
    """Two processes; the second one is started by multiprocessing."""
    sprung = set_traps(tmp_path)
    script = tmp_path.parent / f"{tmp_path.name}.py"
    script.write_text(TRAINING)
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert not sprung.exists()


@pytest.mark.slow
def test_no_code_of_the_current_folder_runs_in_benchmarks_of_training(tmp_path, monkeypatch):
    from idesplat.tools.benchmark import training as bench_training

    sprung = set_traps(tmp_path)
    monkeypatch.chdir(tmp_path)
    phase = next(iter(bench_training.PHASES))
    measured = bench_training._measure(phase, bench_training.Candidate("idesplat-tiny", "float32", 1, 1, 1), 1)
    assert measured["scenes"] == 1
    assert not sprung.exists()


def test_modules_that_run_as_programs_do_not_look_in_the_current_folder(tmp_path):
    """Even without -P: what Python itself imports before it gets to our code is beyond us."""
    (tmp_path / "numpy.py").write_text("raise SystemExit('the current folder')")
    command = [sys.executable, "-m", "idesplat.tools.figures.compare_formats", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_texts_name_the_safe_way_to_run_modules():
    root = Path(__file__).parent.parent.parent
    texts = [root / "Makefile", *root.glob("*.md"), *root.glob("docs/*.md"), *root.glob("[mert]*/*.py")]
    unsafe = [path.name for path in texts if re.search(r"python -m [i]desplat", path.read_text())]
    assert unsafe == []


# ---- what is left behind


@pytest.mark.slow
@pytest.mark.posix
def test_nothing_but_our_cache_is_left_behind(scene, tmp_path):
    """Neither ONNX Runtime's device id and events nor a temporary file."""
    home, temporary, work = (tmp_path / name for name in ("home", "tmp", "work"))
    for folder in (home, temporary, work):
        folder.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "NUMBA_", "ORT_"))}
    environment |= {"HOME": str(home), "TMPDIR": str(temporary)}
    given = ("--images", scene / "images", "--cameras", scene / "transforms.json")
    options = {"env": environment, "cwd": work}
    made = call("idesplat.runtime.cli.infer", *given, "--quality", "fast", "--out", "scene.ply", **options)
    assert made.returncode == 0, made.stderr
    assert {str(path.relative_to(home)) for path in home.glob("*/*")} == {".cache/idesplat"}
    assert not list(temporary.iterdir())
    assert {path.name for path in work.iterdir()} == {"scene.ply"}


def test_compiled_code_is_kept_in_our_cache(tmp_path):
    code = (
        "import idesplat.runtime.rendering.rasterizer_numba as compiled\nprint(compiled._project._cache.cache_path)\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
    assert Path(done.stdout).is_relative_to(tmp_path / "idesplat" / "numba"), done.stderr


@pytest.mark.parametrize(
    "module",
    ["runtime.inference.session", "runtime.inference.providers", "export.graph.cleanup", "tools.benchmark.components"],
)
def test_telemetry_is_off_before_onnx_runtime_is_imported(module):
    code = (
        "import importlib, os, sys\n"
        "class Watch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'onnxruntime':\n"
        "            print(os.environ.get('ORT_DISABLE_TELEMETRY'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        f"importlib.import_module('idesplat.{module}')\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout == "1\n", done.stderr


LEFT = "import sys, time\nfrom idesplat.runtime.system.files import atomic_write\nfrom pathlib import Path\n"
LEFT += "with atomic_write(Path(sys.argv[1])) as temporary:\n"
LEFT += "    temporary.write_text('half')\n    print('writing', flush=True)\n    time.sleep(600)\n"


@pytest.mark.posix
def test_what_killed_processes_left_is_collected(tmp_path):
    """By the next process, and not while the one that it belongs to is alive."""
    out = tmp_path / "out.json"
    writing = subprocess.Popen([sys.executable, "-P", "-c", LEFT, out], stdout=subprocess.PIPE, text=True)
    assert writing.stdout.readline() == "writing\n"
    try:
        write_elsewhere(tmp_path)
        left = [path for path in tmp_path.iterdir() if path.is_dir()]
        assert len(left) == 1 and (left[0] / "out.json").read_text() == "half"
    finally:
        writing.kill()
        writing.communicate()
    assert left[0].exists()
    own = tmp_path / ".idesplat-tmp-images-of-mine"  # no name that we give
    own.mkdir()
    write_elsewhere(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [own.name, "other"]


def write_elsewhere(folder: Path) -> None:
    code = "import sys\nfrom idesplat.runtime.system.files import atomic_write\nfrom pathlib import Path\n"
    code += "with atomic_write(Path(sys.argv[1])) as temporary:\n    temporary.write_text('whole')\n"
    subprocess.run([sys.executable, "-P", "-c", code, folder / "other"], check=True, timeout=60)


@pytest.mark.posix
def test_a_folder_that_was_not_locked_yet_is_made_again(tmp_path, monkeypatch):
    """Another process may take a new folder for an abandoned one, in the moment before it is locked."""
    from idesplat.runtime.system import files

    locks = iter([False])
    original = files._lock

    def lock(descriptor):
        stolen = next(locks, None)
        if stolen is None:
            return original(descriptor)
        shutil.rmtree(next(tmp_path.iterdir()))
        return True

    monkeypatch.setattr(files, "_lock", lock)
    with scratch_folder(tmp_path) as folder:
        assert folder.is_dir()
    assert not list(tmp_path.iterdir())


def test_names_of_any_length_are_written(tmp_path):
    long = tmp_path / ("n" * 250 + ".ply")
    with atomic_write(long) as temporary:
        temporary.write_text("x")
    assert long.read_text() == "x"


# ---- how commands end

# It sleeps in short steps: Python starts a system call although a signal came just before, and nothing ends that early.
WAITING = """
import sys, time
from pathlib import Path
from idesplat.runtime.system.files import atomic_write
from idesplat.runtime.cli.terminal import run

def wait(out: Path) -> None:
    with atomic_write(out) as temporary:
        temporary.write_text("half")
        print("waiting", flush=True)
        while True:
            time.sleep(0.1)

run(wait)
"""


@pytest.mark.posix
@pytest.mark.parametrize("name, status", [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_signals_clean_up(tmp_path, name, status):
    number = getattr(signal, name)
    out = tmp_path / "out.txt"
    command = [sys.executable, "-P", "-c", WAITING, out]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    waiting = subprocess.Popen(command, **pipes, preexec_fn=DEFAULT_SIGNALS)
    assert waiting.stdout.readline() == "waiting\n"
    waiting.send_signal(number)
    printed = waiting.communicate(timeout=60)
    assert (waiting.returncode, printed) == (status, ("", ""))
    assert not list(tmp_path.iterdir())


def test_ctrl_c_while_a_command_is_loaded(tmp_path, monkeypatch, capsys):
    from idesplat.runtime.cli import launch

    (tmp_path / "slow_to_load.py").write_text("raise KeyboardInterrupt")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit) as stop:
        launch._launch("slow_to_load", "command")
    assert stop.value.code == 130
    assert capsys.readouterr() == ("", "")


@pytest.mark.posix
def test_what_the_caller_ignores_stays_ignored(tmp_path):
    command = ["nohup", sys.executable, "-P", "-c", WAITING, tmp_path / "out.txt"]
    waiting = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert waiting.stdout.readline() == "waiting\n"
    waiting.send_signal(signal.SIGHUP)
    time.sleep(0.5)
    assert waiting.poll() is None
    waiting.terminate()
    waiting.communicate(timeout=60)


# ---- what reaches the terminal


@pytest.mark.posix
def test_full_standard_output(tmp_path):
    scene = write_scene(tmp_path / "scene.ply")
    with open("/dev/full", "w") as full:
        options = {"stdout": full, "stderr": subprocess.PIPE, "capture_output": False}
        done = call("idesplat.runtime.cli.convert", scene, tmp_path / "out.splat", **options)
    assert done.returncode == 2
    assert done.stderr.startswith("error: standard output cannot be written (No space left on device)")
    assert done.stderr.count("\n") == 1


@pytest.mark.posix
@pytest.mark.parametrize("arguments", [("scene.ply", "out.splat"), ("--help",)], ids=["results", "help"])
def test_closed_pipe(tmp_path, arguments):
    write_scene(tmp_path / "scene.ply")
    reading, writing = os.pipe()
    os.close(reading)
    options = {"stdout": writing, "stderr": subprocess.PIPE, "capture_output": False, "cwd": tmp_path}
    done = call("idesplat.runtime.cli.convert", *arguments, **options)
    os.close(writing)
    assert done.stderr == ""
    assert done.returncode in (1, 141)


@pytest.mark.posix
def test_streams_that_are_closed(tmp_path):
    scene = write_scene(tmp_path / "scene.ply")
    code = "from idesplat.runtime.cli.convert import main; main()"
    command = f'"{sys.executable}" -P -c "{code}" {scene} {tmp_path / "out.splat"} >&- 2>&-'
    assert subprocess.run(command, shell=True, timeout=60).returncode == 0
    assert (tmp_path / "out.splat").exists()


def test_output_in_ascii(tmp_path):
    scene = write_scene(tmp_path / "scene.ply")
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = call("idesplat.runtime.cli.convert", scene, tmp_path / "Fuß-雪.splat", env=ascii_only)
    assert done.returncode == 0, done.stderr
    assert "Fu\\xdf-\\u96ea.splat" in done.stdout


@pytest.mark.posix
@pytest.mark.parametrize("there", [True, False], ids=["result", "error"])
def test_control_characters_are_not_printed(tmp_path, there):
    """A name that would clear the screen, go back in the line, turn the text around, or is not UTF-8."""
    name = os.fsdecode(b"\x1b[2J\n\r\x07\xe2\x80\xae\xc2\x9b31m\xff.ply")
    scene = tmp_path / name
    if there:
        write_scene(scene)
    done = call("idesplat.runtime.cli.convert", scene, scene.with_suffix(".splat"), text=False)
    assert done.returncode == (0 if there else 2)
    printed = done.stdout + done.stderr
    assert b"\\x1b[2J" in printed and b"\\u202e" in printed
    assert not re.search(rb"[\x00-\x09\x0b-\x1f\x7f\x9b\xff]|\xe2\x80\xae", printed.replace(b"\xc2\x9b", b"\x9b"))
    assert printed.count(b"\n") == 1


def test_names_in_tables_are_no_markup(capsys):
    result = Result("room", ["[/].png"], 1, 2, [Target("[red]\x1b[2J.png", {"model": {"psnr": 20.0}}, {})], {})
    print_views([result])
    printed = capsys.readouterr().out
    assert "[red]\\x1b[2J.png" in printed and "[/].png" in printed


def test_wrong_arguments_are_one_line():
    done = call("idesplat.runtime.cli.convert", "a.ply", "b.ply", "--\x1b[31mred")
    assert done.returncode == 2
    assert done.stderr.startswith("error: No such option: --\\x1b[31mred")
    assert "--help" in done.stderr
    assert done.stderr.count("\n") == 1


NATIVE = """
import os, sys, warnings, logging
from idesplat.runtime.errors import InputError
from idesplat.runtime.cli.terminal import run

def talk(fail: str) -> None:
    os.write(2, b"libpng warning: iCCP: known incorrect sRGB profile\\n")
    warnings.warn("overflow encountered", RuntimeWarning)
    logging.getLogger("PIL").warning("corrupt EXIF")
    if fail == "input":
        raise InputError("the one line")
    if fail == "memory":
        raise MemoryError
    if fail == "bug":
        raise KeyError("ours")

run(talk)
"""


@pytest.mark.parametrize(
    "fail, status, expected",
    [("none", 0, ""), ("input", 2, "error: the one line\n"), ("memory", 2, "error: memory ran out; ")],
)
def test_warnings_of_libraries_are_not_shown(fail, status, expected):
    done = subprocess.run([sys.executable, "-P", "-c", NATIVE, fail], capture_output=True, text=True, timeout=60)
    assert done.returncode == status
    assert done.stderr.startswith(expected) and done.stderr.count("\n") == expected.count("error:")


DECODING = """
import sys
from pathlib import Path
import cv2
from idesplat.runtime.errors import InputError
from idesplat.runtime.cli.terminal import run

def decode(path: Path) -> None:
    cv2.imread(str(path))
    raise InputError("the one line")

run(decode) if len(sys.argv) == 2 else cv2.imread(sys.argv[1])
"""


def test_warnings_of_image_decoders_are_not_shown(tmp_path):
    """libjpeg's, of an image whose end is missing."""
    path = tmp_path / "cut.jpg"
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    path.write_bytes(cv2.imencode(".jpg", noise)[1].tobytes()[:-200])
    command = [sys.executable, "-P", "-c", DECODING, path]
    plain = subprocess.run([*command, "plainly"], capture_output=True, text=True, timeout=60)
    assert "JPEG" in plain.stderr  # or else there is nothing to be kept off
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, "error: the one line\n")


@pytest.mark.posix
@pytest.mark.parametrize("name", ["scene.splat", "scene.spz", "scene.ply", "scene.glb"])
def test_files_larger_than_memory(tmp_path, name):
    scene = tmp_path / name
    if name.endswith("ply"):
        columns = "".join(f"property float {column}\n" for column in COLUMNS)
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex 60000000000\n{columns}end_header\n"
        scene.write_text(header)
    with scene.open("ab") as file:
        file.truncate(1 << 42)  # of which the disk holds nothing
    done = call("idesplat.runtime.cli.convert", scene, tmp_path / "out.splat")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_messages_of_libraries_are_shown_beside_our_own_mistakes():
    done = subprocess.run([sys.executable, "-P", "-c", NATIVE, "bug"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "libpng warning" in done.stderr and "KeyError: 'ours'" in done.stderr


# ---- regular files alone

SPLATS = ("scene.ply", "scene.compressed.ply", "scene.splat", "scene.spz", "scene.sog", "scene.glb")
CAMERAS = ("transforms.json", "own.json", "pose.txt", "stereo.yml", "poses_bounds.npy", "a_cam.txt", "cameras")
OTHERS = ("model.onnx", "index.json", "rows.json", "chunk.torch")
# Where cameras do not find them.
ELSEWHERE = ("a.png", "manifest.json", "clip.mp4", "captures.json", "log.jsonl", "a.ckpt", "a.safetensors")


@pytest.mark.posix
@pytest.mark.parametrize("kind", ["a named pipe", "a device", "a socket", "a folder"])
def test_readers_take_regular_files_alone(tmp_path, kind):
    """In one process, whose limit ends what would hang; every reader names what it met."""
    with contextlib_socket() as listener:
        (tmp_path / "else").mkdir()
        for name in (*SPLATS, *CAMERAS, *OTHERS, *(f"else/{name}" for name in ELSEWHERE)):
            make_special(tmp_path / name, kind, listener)
        code = (
            "import sys\n"
            "from pathlib import Path\n"
            "from idesplat.runtime.cameras.io import CameraFormat, read_cameras\n"
            "from idesplat.runtime.splats.io import read_splats\n"
            "from idesplat.runtime.inference.session import open_session\n"
            "from idesplat.tools.benchmark.report import read_rows\n"
            "from idesplat.tools.evaluation.chunks import read_chunk, read_index\n"
            "from idesplat.model.checkpoint import file_sha256, read_state_dict\n"
            "from idesplat.runtime.inference.metadata import read_manifest\n"
            "from idesplat.runtime.images.header import image_size\n"
            "from idesplat.runtime.images.io import load_image\n"
            "from idesplat.runtime.images.video_reader import extract_sharp_frames\n"
            "from idesplat.tools.evaluation.captures.capture import read_captures\n"
            "from idesplat.tools.training.log import TrainingLog\n"
            f"splats, cameras = {SPLATS!r}, {CAMERAS!r}\n"
            "forms = [CameraFormat.TRANSFORMS, CameraFormat.OWN, CameraFormat.RE10K, CameraFormat.OPENCV,\n"
            "         CameraFormat.LLFF, CameraFormat.DTU]\n"
            "tries = [(read_splats, name) for name in splats] + [(read_cameras, name) for name in cameras]\n"
            "tries += [(lambda p, form=form: read_cameras(p, (), form), name) for form, name in zip(forms, cameras)]\n"
            "tries += [(open_session, 'model.onnx'), (read_index, 'index.json'), (read_rows, 'rows.json')]\n"
            "tries += [(read_chunk, 'chunk.torch'), (image_size, 'else/a.png'), (load_image, 'else/a.png')]\n"
            "tries += [(lambda path: read_manifest(path.parent), 'else/manifest.json')]\n"
            "tries += [(lambda path: extract_sharp_frames(path, Path()), 'else/clip.mp4')]\n"
            "tries += [(lambda path: read_captures(path=path), 'else/captures.json')]\n"
            "tries += [(lambda path: TrainingLog(path, 0), 'else/log.jsonl')]\n"
            "names = ('else/a.ckpt', 'else/a.safetensors')\n"
            "tries += [(read, name) for read in (read_state_dict, file_sha256) for name in names]\n"
            "for reader, name in tries:\n"
            "    try:\n"
            "        reader(Path(name))\n"
            "        print(name, 'was read')\n"
            "    except ValueError as error:\n"
            "        print(name, *[kind.__name__ for kind in type(error).mro()], error)\n"
        )
        done = subprocess.run(
            [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120
        )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == len(SPLATS) + 2 * len(CAMERAS) - 1 + 14
    if kind == "a folder":  # some formats of cameras are folders
        lines = [line for line in lines if line.split()[0] not in CAMERAS]
    checkpoints = [line for line in lines if "CheckpointError" in line and "not a regular file" in line]
    assert len(checkpoints) == 4
    rest = [line for line in lines if line not in checkpoints]
    assert [line for line in rest if "InputError" not in line or kind not in line] == []


def contextlib_socket() -> socket.socket:
    return socket.socket(socket.AF_UNIX if os.name != "nt" else socket.AF_INET)


def make_special(path: Path, kind: str, listener: socket.socket) -> None:
    if kind == "a named pipe":
        os.mkfifo(path)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    elif kind == "a folder":
        path.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as own:
            before = Path.cwd()
            os.chdir(path.parent)  # names of sockets are short
            own.bind(path.name)
            os.chdir(before)


@pytest.mark.posix
def test_a_pipe_in_the_cache_is_replaced(tmp_path, monkeypatch):
    from idesplat.runtime.inference import graph_cache
    from idesplat.runtime.inference.session import open_session

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    place = graph_cache.cache_entry(bundled_model())
    entry = place.folder / f"{place.key}.{'0' * 64}.onnx"
    os.mkfifo(entry)
    open_session(bundled_model())
    assert not entry.exists()
    assert len(list(place.folder.iterdir())) == 1


@pytest.mark.posix
def test_what_was_left_in_the_cache_is_collected(tmp_path, monkeypatch):
    from idesplat.runtime.inference import graph_cache
    from idesplat.runtime.system import files

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    left = tmp_path / "idesplat" / "graphs" / f"{files.SCRATCH_PREFIX}abcdefgh"
    left.mkdir(parents=True)
    (left / files.LOCK_NAME).touch()
    (left / "graph.onnx").write_bytes(b"half")
    assert graph_cache.cache_entry(bundled_model()) is not None
    assert not left.exists()


@pytest.mark.posix
def test_a_pipe_in_a_colmap_model_is_refused(tmp_path):
    for name, text in MODEL.items():
        (tmp_path / name).write_text(text)
    os.mkfifo(tmp_path / "rigs.bin")
    done = call("idesplat.runtime.cli.cameras", "convert", tmp_path, tmp_path / "out.json", timeout=60)
    assert done.returncode == 2
    assert "rigs.bin: is a named pipe" in done.stderr
