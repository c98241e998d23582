"""Response of a carrier at many frequencies from one eigendecomposition of its state space."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.linalg import complex_product, eigenvectors_in_turn, solve_in_turn


class ModalResponse(eqx.Module):
    """Modal form of the dynamic stiffness D(w) = K - w^2 M + i w C of nd coordinates.

        D(w)^-1 = Z diag(1 / (i w - s)) W,      e^H B D(w)^-1 B^T e = sum_k r_k / (i w - s_k)

    At each frequency, the solution for one force vector costs two products of a matrix and a vector, and each receptance costs
    O(nd). There are no derivatives with respect to parameters of the scene, because the eigenvectors of equal eigenvalues have
    no derivatives.

    **Attributes**

    - `poles` s (2 nd,) 1/s, the roots of det(K + s C + s^2 M) = 0; `outputs` Z (nd, 2 nd); `inputs` W (2 nd, nd)
    - `residues` r of the receptance of the mount, (2 nd,), or of the receptances between several masses, (count, count, 2 nd)
    - `norms` (3,), the largest row sums of |K|, |C| and |M|
    - `is_rough`: True if the result may lose more than 2 digits, because eigenvectors are nearly parallel, and for a carrier
      with a natural frequency 0
    """

    poles: Array
    outputs: Array
    inputs: Array
    residues: Array
    norms: Array
    is_rough: Array

    def receptance(self, omega: Array) -> Array:
        """Return the receptance e^H B D^-1 B^T e of the mount, m/N, at the frequency `omega` (scalar, rad/s), or the
        receptances e_i^H B_i D^-1 B_k^T e_k (count, count) between several masses.

        The sum is a loop over the poles. In a batch each of its steps is then computed for many frequencies by vector
        instructions, which for 200 platforms takes a fifth of the time of sums over arrays. The sum uses real numbers; the
        imaginary part of the receptance of an undamped carrier is then exactly 0.
        """
        residues = jnp.moveaxis(self.residues, -1, 0)

        def add(total: tuple[Array, Array], term: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
            decay, centre, real, imag = term
            detuning = omega - centre
            weight = _reciprocal(decay**2 + detuning**2)
            parts = (real * decay + imag * detuning) * weight, (imag * decay - real * detuning) * weight
            return (total[0] + parts[0], total[1] + parts[1]), None

        zero = jnp.zeros(residues.shape[1:], residues.real.dtype)
        terms = -self.poles.real, self.poles.imag, residues.real, residues.imag
        return jax.lax.complex(*jax.lax.scan(add, (zero, zero), terms)[0])

    @property
    def transposed(self) -> ModalResponse:
        """The modal form of D^T, which differs from D if the damping matrix is not symmetric."""
        return dataclasses.replace(self, outputs=self.inputs.T, inputs=self.outputs.T)

    def solve(self, omega: Array, force: Array) -> Array:
        """Return D^-1 f (nd,), m, for amplitudes `force` f (nd,), N."""
        amplitudes = complex_product(self.inputs, force) / jax.lax.complex(-self.poles.real, omega - self.poles.imag)
        return complex_product(self.outputs, amplitudes)

    def norm(self, omega: Array) -> Array:
        """Return an upper bound of the row sums of |D(w)|, N/m."""
        return self.norms @ jnp.stack([jnp.ones_like(omega), omega, omega**2])


@jax.custom_jvp
def _reciprocal(x: Array) -> Array:
    """Return 1/x, with a derivative without another division: divisions take half of the time of a sum over poles."""
    return 1.0 / x


@_reciprocal.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    value = _reciprocal(*primals)
    return value, -(value**2) * tangents[0]


def modal_response(
    frequencies: Array, shapes: Array, stiffness: Array, damping: Array, mass: Array, direction: Array
) -> ModalResponse:
    """Return the modal form of a carrier.

        (Omega q)' = Omega v,      v' = -Omega (Omega q) - Gamma v + X^T f,      Gamma = X^T C X

    q are the coordinates of the undamped modes X with the frequencies Omega, and v = q'. Proportional damping does not couple
    the modes. Each mode is then a separate block, whose eigenvalues are accurate to rounding, and this damping needs no
    separate case.

    **Arguments**: undamped `frequencies` (nd,) rad/s and mass-normalized `shapes` (nd, nd); `stiffness` K, `damping` C
    and `mass` M (nd, nd); `direction` B^T e (nd,), or those of several masses (count, nd).
    """
    n, eps = frequencies.shape[0], jnp.finfo(frequencies.dtype).eps
    positive = jnp.where(frequencies > 0.0, frequencies, jnp.inf)
    # The displacement q is computed from the state Omega q by a division by Omega. A coordinate without a spring (Omega = 0)
    # therefore gets a spring that is too soft to have an effect at any load speed.
    drift_frequency = jnp.where(jnp.isfinite(jnp.min(positive)), jnp.min(positive), 1.0) * eps ** (1 / 3)
    stiff = jnp.where(frequencies > 0.0, frequencies, drift_frequency)
    coupling, rounding = shapes.T @ damping @ shapes, jnp.abs(shapes.T) @ jnp.abs(damping) @ jnp.abs(shapes)
    coupling = jnp.where(jnp.abs(coupling) > 4.0 * n * eps * rounding, coupling, 0.0)
    # With critical damping two poles share one eigenvector. A relative change of the damping by eps^(2/3) separates them.
    critical = jnp.abs(jnp.diagonal(coupling) / (2.0 * stiff) - 1.0) < eps ** (2 / 3)
    coupling = coupling * (1.0 + eps ** (2 / 3) * jnp.diag(critical.astype(coupling.dtype)))
    blocks = jnp.zeros((n, 2, n, 2), coupling.dtype)  # the two states of a mode side by side
    diagonal = jnp.diag(stiff)
    blocks = blocks.at[:, 0, :, 1].set(diagonal).at[:, 1, :, 0].set(-diagonal).at[:, 1, :, 1].set(-coupling)
    poles, vectors = eigenvectors_in_turn(blocks.reshape(2 * n, 2 * n))
    unit = np.eye(2 * n, dtype=coupling.dtype)[:, 1::2]
    inverse = solve_in_turn(vectors, unit.astype(vectors.dtype))
    outputs, inputs = complex_product(shapes / stiff[None, :], vectors[0::2]), complex_product(shapes, inverse.T).T
    condition = jnp.linalg.norm(vectors) * jnp.linalg.norm(inverse)
    left, right = direction.conj() @ outputs, direction @ inputs.T
    return ModalResponse(
        poles=poles,
        outputs=outputs,
        inputs=inputs,
        residues=left * right if direction.ndim == 1 else left[:, None] * right[None],
        norms=jnp.stack([jnp.max(jnp.sum(jnp.abs(a), axis=1)) for a in (stiffness, damping, mass)]),
        is_rough=(condition > 100.0 * n) | jnp.any(frequencies <= 0.0),
    )
