"""A Vulkan driver without a GPU, for the WebGPU plug-in: Chromium's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FOLDERS = ("/usr/lib/chromium", "/opt/google/chrome")


def environment() -> dict[str, str]:
    """The environment of a process in which the plug-in finds a software adapter; skips the test without one."""
    pytest.importorskip("onnxruntime_ep_webgpu")
    for folder in map(Path, FOLDERS):
        driver = folder / "vk_swiftshader_icd.json"
        if driver.exists() and (folder / "libvulkan.so.1").exists() and shutil.which("chromium"):
            added = {
                "LD_LIBRARY_PATH": str(folder),
                "VK_DRIVER_FILES": str(driver),
                "ORT_WEBGPU_EP_ALLOW_SOFTWARE_ADAPTER": "1",
            }
            return os.environ | added
    pytest.skip("no Chromium with a Vulkan driver in software")


def run_on_webgpu(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a Python program in a process that has the software adapter."""
    command = [sys.executable, "-P", "-c", program, *map(str, arguments)]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
