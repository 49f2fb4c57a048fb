"""The SH basis and quaternions of the model are those of the runtime, which share no code."""

import numpy as np
import pytest
import torch
from idesplat.model.common import quaternions, sh
from idesplat.runtime.geometry import quaternions as runtime_quaternions
from idesplat.runtime.geometry import sh as runtime_sh


def unit_vectors(count: int, size: int) -> np.ndarray:
    vectors = np.random.default_rng(0).standard_normal((count, size))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("name", ("SH_0", "SH_1", "SH_2", "SH_3"))
def test_sh_constants_are_those_of_the_runtime(name: str) -> None:
    assert getattr(sh, name) == getattr(runtime_sh, name)


@pytest.mark.parametrize("coefficients", (1, 4, 9, 16))
def test_sh_basis_is_that_of_the_runtime(coefficients: int) -> None:
    directions = unit_vectors(50, 3)
    found = sh.sh_basis(torch.from_numpy(directions), coefficients)
    np.testing.assert_allclose(found, runtime_sh.sh_basis(directions, coefficients), rtol=1e-12, atol=1e-15)


def test_rotation_matrices_are_those_of_the_runtime() -> None:
    quats = unit_vectors(50, 4)
    found = quaternions.quaternions_to_matrices(torch.from_numpy(quats))
    np.testing.assert_allclose(found, runtime_quaternions.quaternions_to_matrices(quats), atol=1e-12)
    back = quaternions.matrices_to_quaternions(found)
    np.testing.assert_allclose(np.abs((back.numpy() * quats).sum(1)), 1, atol=1e-12)


def test_rotated_sh_coefficients_keep_the_colour_of_rotated_directions() -> None:
    """The composition of the two rotations differs from the rotation by both only by the change of basis before it."""
    first, second = quaternions.quaternions_to_matrices(torch.from_numpy(unit_vectors(2, 4)))
    basis = sh.sh_rotation(torch.eye(3, dtype=torch.float64)[None], 9)[0]
    one, other, both = (sh.sh_rotation(turn[None], 9)[0] for turn in (first, second, second @ first))
    torch.testing.assert_close(other @ torch.linalg.inv(basis) @ one, both)
