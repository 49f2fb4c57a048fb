"""The type declarations of the page's module, read by TypeScript's compiler."""

import shutil
import subprocess
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[3] / "runtime" / "web" / "page"
OPTIONS = ["--noEmit", "--strict", "--target", "es2022", "--module", "es2022", "--moduleResolution", "bundler"]
LIBRARIES = ["--lib", "es2022,dom,dom.iterable"]
# The compiler reports a line marked as an error that is none.
USE = """
import { parseColmap, reconstruct, toSpz, type Camera } from "PAGE/idesplat.js";

export async function spzOf(files: File[], transforms: File, note: (line: string) => void): Promise<Blob> {
  const { ply, depth, gaussians, notes } = await reconstruct(files, JSON.parse(await transforms.text()), {
    provider: "wasm",
    onProgress: ({ stage, share }) => note(`${stage}: ${share ?? 0}`),
  });
  const nearest: number = Math.min(...depth.data), bytes: number = ply.size;
  notes.forEach(note);
  note(`${nearest} ${bytes} ${depth.height * depth.width * depth.views}`);
  // @ts-expect-error: no Gaussians
  await toSpz(depth);
  return toSpz(gaussians);
}

export const withColmap = (files: File[], cameras: Camera[] = parseColmap("", "")) => reconstruct(files, cameras);
// @ts-expect-error: no such provider
export const onCuda = (files: File[]) => reconstruct(files, null, { provider: "cuda" });
// @ts-expect-error: the share may be null
export const halved = (files: File[]) => reconstruct(files, null, { onProgress: ({ share }) => share / 2 });
"""


def errors(*arguments: str | Path) -> str:
    tsc = Path(__file__).parents[2] / "npm" / "node_modules" / ".bin" / "tsc"
    if shutil.which("node") is None or not tsc.exists():
        pytest.skip("Node.js or tests/npm/node_modules is missing (make setup)")
    command = [tsc, *OPTIONS, *LIBRARIES, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout


def test_a_typed_program_can_use_the_module(tmp_path: Path) -> None:
    program = tmp_path / "use.ts"
    program.write_text(USE.replace("PAGE", str(PAGE)))
    assert errors(program) == ""


def test_the_module_is_what_its_declarations_say() -> None:
    """Its functions are annotated with the types of the declarations; parameters of others may have none."""
    assert errors("--noImplicitAny", "false", "--allowJs", "--checkJs", PAGE / "idesplat.js") == ""
