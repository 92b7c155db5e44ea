"""The energy in torch is the energy of NumPy: every family, every kernel, values and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from adam_samples import FAMILIES, FAMILY_IDS, random_batch, random_state, torch_parameters

from uni4d_fg.factors import FactorType, Kernel
from uni4d_fg.factors.variable_types import LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import rotation_matrix
from uni4d_fg.optim.problem import Problem, all_free

SMOOTH_KERNELS = [
    Kernel("quadratic"),
    Kernel("huber", 1.3),
    Kernel("pseudo_huber", 0.7),
    Kernel("cauchy", 2.0),
]
KERNELS = [*SMOOTH_KERNELS, Kernel("norm", 0.1)]


@pytest.mark.parametrize("kernel", SMOOTH_KERNELS, ids=lambda kernel: kernel.kind)
@pytest.mark.parametrize("family", FAMILIES, ids=FAMILY_IDS)
def test_every_family_has_the_energy_of_numpy(family: FactorType, kernel: Kernel, rng: np.random.Generator) -> None:
    state = random_state(rng)
    batches = (random_batch(family, rng, kernel), random_batch(family, rng, Kernel()))
    problem = Problem(batches, all_free(state, *set(family.variables)))
    parameters, energy = torch_parameters(problem, state)
    terms = energy.terms(parameters.current())
    expected = problem.energies(state)
    assert terms.keys() == expected.keys()
    for name, value in expected.items():
        assert float(terms[name].detach()) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("family", FAMILIES, ids=FAMILY_IDS)
def test_a_norm_kernel_is_the_plain_norm(family: FactorType, rng: np.random.Generator) -> None:
    state = random_state(rng)
    batch = random_batch(family, rng, Kernel("norm", 0.1), unit_sigma=True)
    problem = Problem((batch,), all_free(state, *set(family.variables)))
    parameters, energy = torch_parameters(problem, state)
    expected = problem.energies(state, exact=True)[batch.name]
    assert float(energy(parameters.current()).detach()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("family", FAMILIES, ids=FAMILY_IDS)
def test_frozen_groups_give_the_same_energy(family: FactorType, rng: np.random.Generator) -> None:
    state = random_state(rng)
    problem = Problem((random_batch(family, rng, Kernel("huber", 1.3)),), all_free(state, family.variables[0]))
    parameters, energy = torch_parameters(problem, state)
    value = float(energy(parameters.current()).detach())
    assert value == pytest.approx(sum(problem.energies(state).values()), rel=1e-9)


@pytest.mark.parametrize("kernel", SMOOTH_KERNELS, ids=lambda kernel: kernel.kind)
@pytest.mark.parametrize("family", FAMILIES, ids=FAMILY_IDS)
def test_the_gradient_is_that_of_the_linearization(
    family: FactorType, kernel: Kernel, rng: np.random.Generator
) -> None:
    state = random_state(rng)
    batch = random_batch(family, rng, kernel)
    groups = set(family.variables)
    parameters, energy = torch_parameters(Problem((batch,), all_free(state, *groups)), state)
    energy(parameters.current()).backward()
    gradient = {name: value.grad.numpy() for name, value in parameters.values.items()}

    r, jacobians = batch.linearize(state)
    expected = {group: np.zeros((len(state[group]), group.dim)) for group in groups}
    for slot, jacobian in zip(batch.slots, jacobians, strict=True):
        np.add.at(expected[slot.variable], slot.rows, np.einsum("ndk,nd->nk", jacobian, r))
    if POSE in groups:
        gradient["pose"] = body_frame_gradient(state[POSE], gradient["pose.rotation"], gradient["pose.center"])
    for group in groups:
        scale = np.abs(expected[group]).max()
        np.testing.assert_allclose(gradient[group.name], expected[group], rtol=1e-7, atol=1e-8 * scale + 1e-12)


def body_frame_gradient(poses: np.ndarray, by_rotation: np.ndarray, by_center: np.ndarray) -> np.ndarray:
    """Chain gradients of rotation vector and center to the twist of ``T Exp(xi)``."""
    omega = se3.so3_log(poses[:, :3, :3])
    angle = np.linalg.norm(omega, axis=1)[:, None, None]
    w = se3.skew(omega)
    inverse_right = np.eye(3) + 0.5 * w + (1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))) * (w @ w)
    turn = np.einsum("nij,ni->nj", inverse_right, by_rotation)
    shift = np.einsum("nij,ni->nj", poses[:, :3, :3], by_center)
    return np.concatenate([turn, shift], axis=1)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.kind)
def test_kernels_agree_with_numpy_and_have_the_gradient_of_the_weight(kernel: Kernel) -> None:
    squared = np.array([0.0, 1e-20, 1e-8, 0.25, kernel.threshold**2, 4.0, 1e4])
    tensor = torch.tensor(squared, requires_grad=True)
    value = kernel.rho(tensor)
    np.testing.assert_allclose(value.detach().numpy(), kernel.rho(squared), rtol=1e-12)
    value.sum().backward()
    np.testing.assert_allclose(tensor.grad.numpy(), 0.5 * kernel.weight(squared), rtol=1e-12)


def test_the_plain_norm_has_a_zero_gradient_at_zero(rng: np.random.Generator) -> None:
    state = random_state(rng)
    batch = random_batch(FAMILIES[FAMILY_IDS.index("log_scale_prior-1")], rng, Kernel("norm", 0.1))
    batch.data["measured"][:] = state[LOG_SCALE][batch.slots[0].rows]
    parameters, energy = torch_parameters(Problem((batch,), all_free(state, LOG_SCALE)), state)
    energy(parameters.current()).backward()
    np.testing.assert_array_equal(parameters.values["log_scale"].grad.numpy(), 0.0)


def test_rotation_vectors_make_the_matrices_of_the_exponential_map(rng: np.random.Generator) -> None:
    direction = rng.normal(size=(8, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    omega = direction * np.array([0.0, 1e-12, 1e-6, 9e-5, 1.1e-4, 0.3, 2.0, 3.1])[:, None]
    np.testing.assert_allclose(rotation_matrix(omega), se3.so3_exp(omega), atol=1e-14)
    np.testing.assert_allclose(rotation_matrix(torch.tensor(omega)).numpy(), se3.so3_exp(omega), atol=1e-14)


def test_the_rotation_matrix_is_differentiable_at_zero() -> None:
    jacobian = torch.autograd.functional.jacobian(rotation_matrix, torch.zeros(1, 3, dtype=torch.float64))
    expected = np.stack([se3.skew(axis) for axis in np.eye(3)], axis=-1)
    np.testing.assert_allclose(jacobian.numpy()[0, :, :, 0, :], expected, atol=1e-14)
