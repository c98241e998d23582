"""Averaged equations of motion: complex amplitudes of the carrier and load speeds in place of vibrations.

**Symbols.** q are the coordinates of the carrier. M, C, K and G are its mass, damping, stiffness and gyroscopic matrices, and
M includes the masses of the loads. n is the rotor speed. Load j has the mass m_j, the angle phi_j, the radius R_j, the inertia
factor kappa_j (7/5 for balls) and the drag b_Wj; B_j q is the displacement of the point that carries it (B q if all loads have
one point).

**Carrier.** Let theta be the loads' mean angle and Omega = theta' their mean rate, phi_j = theta + psi_j, w_j = phi_j'. The
motion is q = Re(Y e^{i theta}), q' = Re(V e^{i theta}), and the position of a load relative to its point is
p_j = R_j Re(exp(i phi_j) e), where e is the vector (1, -i) of the directions (horizontal, up). The carrier's equations
M q'' + (C + n G) q' + K q = - sum_j m_j B^T p_j'' become without any approximation

    Y' = V - i Omega Y
    V' = A - i Omega V,     M A = - (C + n G) V - K Y + B^T e sum_j S_j e^{i psi_j} (w_j^2 - i w_j'),     S_j = m_j R_j

A is the complex amplitude of the acceleration. No derivative of Y is dropped. Beats, free vibrations after the passage of a
resonance, and the coupling of coordinates by the rotor speed are therefore included exactly.

**Averaged loads.** Let I_j = kappa_j m_j R_j^2 and D_j = b_Wj R_j^2. The load's equation contains the product of two quantities
that turn with theta. The averaged equation keeps the slow part of this product and drops the part at twice the speed:

    I_j w_j' = D_j (n - w_j) - (S_j/2) Im(e^{-i psi_j} a_j),     psi_j' = w_j - Omega,     a_j = e^H B_j A

Only a_j, the forward circular part of the acceleration at the load, drives the load; the backward part averages to zero. All
loads at one point have the same a. For loads at different stations s_j, B_j = B + s_j T, where B q is the displacement of
the centre of mass and T q its change per length of the axis. Then a_j = a_B + s_j a_T with a_B = e^H B A and a_T = e^H T A. A
contains w_j' (the reaction of the loads). Therefore a, or (a_B, a_T), is the solution of a linear system. With the levers
g_j = 1 or (1, s_j), P = e^H B M^-1 B^T e (with stations a 2 x 2 matrix, from B and T), h_j = S_j^2/(4 I_j) and
f_j = D_j (n - w_j)/I_j
(the load's angular acceleration without vibration), the system is

    (1 - P sum_j h_j g_j g_j^T) a + P sum_j h_j e^{2 i psi_j} g_j g_j^T conj(a)
        = - e^H B M^-1 ((C + n G) V + K Y) + P sum_j g_j S_j e^{i psi_j} (w_j^2 - i f_j)

**Error.** The dropped torque makes the loads' angles vibrate at twice their speed with the amplitude
r_j = S_j |e^T B_j A| / (2 I_j (2 w_j)^2) rad. The relative error is of the order of r_j, that is of first order in
eps = S/(M R), the loads' share of the mass, times the dynamic magnification. If a rotating force makes the carrier move on a
circle (two equal directions), e^T B A = 0 and the averaged equations are exact.

The equilibria are exactly the leading-order jams: V = i Omega Y and A = -Omega^2 Y turn the equations into those of
`JammedModel.displacement` and `rotor_speed_at`. Gravity and every other potential of the load's angle have mean torque 0.

**Several exciters.** The same equations are valid for every rotating mass, a load or an unbalanced rotor, in either direction:
its angle in the fixed frame is sigma phi with sigma = +1 (anticlockwise) or -1, and e = (1, -i sigma). The motor of an
unbalance gives the torque T(w) in place of that of the drag, and I is the inertia of its rotor; under an ideal drive I is
infinite. All exciters share the amplitudes Y and V. A set of amplitudes Y_k for each exciter, Y_k' = V_k - i w_k Y_k,
describes the same motion with Y = sum_k Y_k e^{i psi_k}, because the equations are linear in them. The equations are therefore
valid for exciters of different speeds too: Y then beats at the differences of the speeds. The rotation of a housing with the
machine, which changes the torque of a motor by -T'(w) c q' (c q': angular velocity of the housing), is neglected.

Source: the method of averaging, N. N. Bogoliubov, Yu. A. Mitropolsky, Asymptotic Methods in the Theory of Non-linear
Oscillations, 1961; I. I. Blekhman, Synchronization in Science and Technology, 1988. The averaged equations are (1), (2) of the
antiphase paper in general form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import LinearModel, linear_model, require_circular, require_terms, turning_loads
from jaxvib.equations.model import Group, grouped, ungroup
from jaxvib.equations.state import State
from jaxvib.errors import InputError, within
from jaxvib.machine.carrier import Mount
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.terms import GravityField, LoadPotential, Term
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.numerics.linalg import eigenvalues_in_turn, magnitude, small_solve, times, unrolled_inverse

AVERAGED_TERMS = (GravityField, LoadPotential)
"""Terms that the averaged equations include: potentials, whose mean torque is 0."""

LATE = 1e30
"""Time after all changes of the drives, s, at which steady motions are computed. It is finite, because the derivatives of a
product with an infinite time are NaN, even in the branch of a `where` that is not selected."""

_MIN_DAMPING = 1e-9
"""Decay rate, relative to the speed, below which a motion is not called stable: smaller computed rates can be rounding
errors."""

_CIRCLE = (1.0, -1.0j)


def mean_torque(unbalance: Array, acceleration: Array) -> Array:
    """Return -(S/2) Im(e^{-i psi} a), N m: the mean torque of a vibration on loads with the `unbalance` S, from
    `acceleration` e^{-i psi} a, m/s^2, an array of the same shape."""
    return -unbalance * acceleration.imag / 2.0


class Amplitudes(eqx.Module):
    """Slowly changing motion, or the time derivative of one.

        q = Re(displacement e^{i theta}),  q' = Re(velocity e^{i theta}),  phi_j = theta + phase_j,  theta' = mean of rate_j

    **Attributes**: `displacement` Y (nd,) m and `velocity` V (nd,) m/s, complex; `rate` w_j (count,) rad/s; `phase` psi_j
    (count,) rad.
    """

    displacement: Array
    velocity: Array
    rate: Array
    phase: Array


class Averaged(eqx.Module):
    """Averaged equations of a scene for time integration; a pure function of time (s) and `Amplitudes`.

    - `stiffness` M^-1 K, `damping` M^-1 C, `gyroscopic` M^-1 G or None, (nd, nd), where M includes the loads' masses
    - `port` (levers, p, nd): B and, if loads have stations, T, of each exciter, in the p directions of the mount;
      `input_matrix`: M^-1 times their transposes, (levers, p, nd)
    - `levers` g (levers, count): 1 and, if loads have stations, s_j in m; 0 for the rows of other exciters. None if there would
      be more rows than coordinates. `port` and `input_matrix` then have a row B_j for each mass, and the equations are solved
      for the accelerations of the coordinates; the cost is linear in the number of masses
    - `unbalance` S_j kg m, `inertia` I_j kg m^2, `drag` D_j N m s of each rotating mass, all (count,)
    - `groups` of the exciters' drives, see `Group`
    - `axes`: the p directions of the mount, 0 horizontal, 1 up
    - of each exciter: `counts`, the number of its loads, 0 for an unbalance; `directions` of rotation, 1 or -1
    - `owners`: the number of the exciter to which each row of `port` belongs
    - `other_rotors`: speeds, anticlockwise, rad/s, of the rotors whose masses are not part of the equations; the gyroscopic
      matrix of the machine belongs to them too
    """

    stiffness: Array
    damping: Array
    gyroscopic: Array | None
    input_matrix: Array
    port: Array
    levers: Array | None
    unbalance: Array
    inertia: Array
    drag: Array
    groups: tuple[Group[Drive], ...]
    axes: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)
    directions: tuple[int, ...] = eqx.field(static=True)
    owners: tuple[int, ...] = eqx.field(static=True)
    other_rotors: tuple[Array, ...] = ()

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the exciters, in order."""
        return tuple(ungroup(self.groups, (group.part for group in self.groups)))

    @property
    def is_prescribed(self) -> np.ndarray:
        """True for the unbalances under ideal drives, whose speed is prescribed, (count,)."""
        ideal = {k for group in self.groups if group.part.ideal for k in group.members}
        each = [[count == 0 and k in ideal] * max(count, 1) for k, count in enumerate(self.counts)]
        return np.concatenate(each)

    @property
    def free_shifts(self) -> int:
        """Number of zero eigenvalues from shifts of phases: 1 for a common shift, or 1 for each prescribed phase."""
        return max(int(np.sum(self.is_prescribed)), 1)

    def __call__(self, t: Array, state: Amplitudes) -> Amplitudes:
        """Return the time derivative of `state` at time `t`."""
        acceleration, rate, _ = self._accelerations(t, state)
        rotation = 1j * jnp.mean(state.rate)
        return Amplitudes(
            displacement=state.velocity - rotation * state.displacement,
            velocity=acceleration - rotation * state.velocity,
            rate=rate,
            phase=state.rate - rotation.imag,
        )

    def _accelerations(self, t: Array, state: Amplitudes) -> tuple[Array, Array, Array]:
        """Return the acceleration A (nd,), the accelerations of the masses (count,), and the forward circular part of A at each
        mass (count,)."""
        speeds = self.rotor_speeds(t, state.rate)
        at = jnp.cos(state.phase) + 1j * jnp.sin(state.phase)
        free = self.driving_torque(t, speeds, state.rate) / self.inertia
        if any(self.is_prescribed):
            free = free + self._prescribed_acceleration(t)
        unforced = -times(self.stiffness, state.displacement) - times(self.damping, state.velocity)
        if self.gyroscopic is not None:
            unforced = unforced - self.gyroscopic_speed(speeds) * times(self.gyroscopic, state.velocity)

        circle, levers = self._circle(), self.levers
        input_column = jnp.sum(self.input_matrix * circle, axis=1)
        output_row = jnp.sum(self.port * jnp.conj(circle), axis=1)

        def unbalance_force(rate: Array) -> Array:
            force = self.unbalance * at * (state.rate**2 - 1j * rate)
            return force if levers is None else jnp.sum(levers * force[None, :], axis=-1)

        if levers is None:
            acceleration, forward = self._solve_in_coordinates(input_column, output_row, at, unforced, unbalance_force(free))
            rate = free + mean_torque(self.unbalance, jnp.conj(at) * forward) / self.inertia
        else:
            accelerance = jnp.sum(output_row[:, None, :] * input_column[None, :, :], axis=-1)
            share = levers[:, None, :] * levers[None, :, :] * (self.unbalance**2 / (4.0 * self.inertia))[None, None, :]
            alone = jnp.eye(levers.shape[0]) - _product(accelerance, jnp.sum(share, axis=-1))
            mirrored = _product(accelerance, jnp.sum(share * (at**2)[None, None, :], axis=-1))
            right = times(output_row, unforced) + times(accelerance, unbalance_force(free))
            forward = jnp.sum(levers * _with_conjugate(alone, mirrored, right)[:, None], axis=0)
            rate = free + mean_torque(self.unbalance, jnp.conj(at) * forward) / self.inertia
            acceleration = unforced + jnp.sum(input_column * unbalance_force(rate)[:, None], axis=0)
        return acceleration, rate, forward

    def shifted_inverse(self, t: Array, state: Amplitudes, shift: Array) -> Callable[[Amplitudes], Amplitudes]:
        """Return the function that maps r to the solution x of (shift - J) x = r, with the Jacobian J of this field at `state`.

        A mass depends on the other masses only through the changes z of V and of Omega. For given z the two unknowns of a mass
        follow from one division. The remaining equations for z are few, and the cost is linear in the number of masses:

            (shift - a - b/shift) dw = Re(c^H dA) + r_w + (b/shift) (r_psi - dOmega),   shift dpsi = dw - dOmega + r_psi
            (shift + i Omega) (dY, dV) = (dV - i Y dOmega + r_Y, dA - i V dOmega + r_V),   dOmega = mean of dw

        Here a and b are the derivatives of a mass's acceleration w' with respect to its speed and its phase. Re(c^H dA) is the
        change of w' due to the change dA of the acceleration A. dA follows from the equation of the carrier.
        """
        _, rate, forward = self._accelerations(t, state)
        omega, nd = jnp.mean(state.rate), state.velocity.shape[0]
        phasors, circle = jnp.cos(state.phase) + 1j * jnp.sin(state.phase), self._circle()
        u, v = (jnp.sum(each, axis=1) for each in (self.input_matrix * circle, self.port * jnp.conj(circle)))
        if self.levers is not None:
            u, v = (jnp.matmul(self.levers.T, each, precision="highest") for each in (u, v))

        def free(w: Array) -> Array:
            return self.driving_torque(t, self.rotor_speeds(t, w), w) / self.inertia

        def gyroscopic_speed(w: Array) -> Array:
            return self.gyroscopic_speed(self.rotor_speeds(t, w))

        by_rate = jax.jvp(free, (state.rate,), (jnp.ones_like(state.rate),))[1]
        by_phase = self.unbalance * (jnp.conj(phasors) * forward).real / (2.0 * self.inertia) / shift
        rate_response = 1.0 / (shift - by_rate - by_phase)
        force = self.unbalance * phasors * (state.rate**2 - 1j * rate)
        spin = shift + 1j * omega

        def completed(z: Array, r: Amplitudes) -> tuple[Array, Amplitudes]:
            """Return the residuals of the equations for the changes z, and the solution, valid if the residuals are 0."""
            dv, domega = z[:nd] + 1j * z[nd : 2 * nd], z[2 * nd]
            da = spin * dv + 1j * state.velocity * domega - r.velocity
            dy = (dv - 1j * state.displacement * domega + r.displacement) / spin
            along = mean_torque(self.unbalance, jnp.conj(phasors) * jnp.sum(v * da[None, :], axis=-1)) / self.inertia
            dw = rate_response * (along + r.rate + by_phase * (r.phase - domega))
            dpsi = (dw - domega + r.phase) / shift
            dforce = self.unbalance * phasors * (2.0 * state.rate * dw - 1j * (shift * dw - r.rate)) + 1j * force * dpsi
            carrier = jnp.sum(u * dforce[:, None], axis=0) - times(self.stiffness, dy) - times(self.damping, dv)
            if self.gyroscopic is not None:
                speed, change = jax.jvp(gyroscopic_speed, (state.rate,), (dw,))
                carrier = carrier - times(self.gyroscopic, speed * dv + change * state.velocity)
            residual = da - carrier
            return jnp.concatenate([residual.real, residual.imag, (domega - jnp.mean(dw))[None]]), Amplitudes(dy, dv, dw, dpsi)

        nothing = jax.tree.map(jnp.zeros_like, state)
        unit = jnp.eye(2 * nd + 1, dtype=rate.dtype)
        inverse = unrolled_inverse(jax.vmap(lambda z: completed(z, nothing)[0], out_axes=1)(unit))

        def solve(r: Amplitudes) -> Amplitudes:
            residual = completed(jnp.zeros_like(unit[0]), r)[0]
            return completed(-jnp.sum(inverse * residual[None, :], axis=1), r)[1]

        return solve

    def _solve_in_coordinates(self, u: Array, v: Array, at: Array, unforced: Array, force: Array) -> tuple[Array, Array]:
        """Return the acceleration A (nd,) and its forward circular part at each rotating mass (count,).

        It is the solution of (1 - sum_j h_j u_j v_j^T) A + sum_j h_j e^{2 i psi_j} u_j conj(v_j)^T conj(A) = right side, with
        u_j = M^-1 B_j^T e and v_j = e^H B_j. The cost is linear in the number of rotating masses.
        """
        weighted = (self.unbalance**2 / (4.0 * self.inertia))[:, None] * u
        alone = jnp.eye(unforced.shape[0]) - jnp.matmul(weighted.T, v, precision="highest")
        mirrored = jnp.matmul((weighted * (at**2)[:, None]).T, jnp.conj(v), precision="highest")
        acceleration = _with_conjugate(alone, mirrored, unforced + jnp.sum(u * force[:, None], axis=0))
        return acceleration, times(v, acceleration)

    def rotor_speeds(self, t: Array, rate: Array) -> list[Array]:
        """Return the rotor speeds of each group, rad/s, positive in the direction of rotation of each exciter, from the rates
        (count,) of the rotating masses."""

        def speed(drive: Drive, first: Array | None) -> Array:
            return drive.rotor_speed(t, None if first is None else (jnp.zeros_like(t), first))

        begins = np.cumsum([0, *(max(count, 1) for count in self.counts)])
        first = (begins[list(group.members)] for group in self.groups)
        return [
            group.each(speed, None if group.part.ideal else rate[at[0] if at.size == 1 else at])
            for group, at in zip(self.groups, first, strict=True)
        ]

    def by_exciter(self, values: Sequence[Array]) -> list[Array]:
        """Return the values of each exciter from those of each group."""
        return ungroup(self.groups, values)

    def gyroscopic_speed(self, speeds: Sequence[Array]) -> Array:
        """Return the factor of the gyroscopic matrix: the mean of `rotor_speeds` and `other_rotors`, anticlockwise, rad/s."""
        turned = [n if way == 1 else -n for way, n in zip(self.directions, self.by_exciter(speeds), strict=True)]
        turned += self.other_rotors
        return turned[0] if len(turned) == 1 else sum(turned[1:], turned[0]) / len(turned)

    def driving_torque(self, t: Array, speeds: Sequence[Array], rate: Array) -> Array:
        """Return the torque of the drag on each load and of the motor on each unbalance (0 for a prescribed speed), (count,)
        N m.

        **Arguments**: `t`, s; `speeds` of the rotors, see `rotor_speeds`; `rate` (count,) of the masses, rad/s.
        """
        if len(self.counts) == 1 and self.counts[0]:
            return self.drag * (speeds[0] - rate)
        torques = []
        for group, masses, n in zip(self.groups, self._masses_of_groups(), speeds, strict=True):
            motor, count = group.each(lambda drive, n: drive.torque_and_inertia(t, n), n), self.counts[group.members[0]]
            if count or motor is None:
                n = n if n.ndim == 0 else jnp.repeat(n, max(count, 1))
                torques.append(self.drag[masses] * (n - rate[masses]))
            else:
                torques.append(motor[0][None] if n.ndim == 0 else motor[0])
        return self._in_order(torques)

    def _prescribed_acceleration(self, t: Array) -> Array:
        """Return the accelerations of the masses of prescribed speed, 0 for others, (count,) rad/s^2."""
        each = []
        for group in self.groups:
            count = self.counts[group.members[0]]
            change = None if count else group.each(lambda drive: drive.rotor_acceleration(t))
            if change is None:
                each.append(jnp.zeros(len(group.members) * max(count, 1), self.drag.dtype))
            else:
                each.append(change[None] if change.ndim == 0 else change)
        return self._in_order(each)

    def _masses_of_groups(self) -> list[slice | np.ndarray]:
        """Return the numbers of the rotating masses of each group."""
        ends = np.cumsum([max(count, 1) for count in self.counts])
        each = [np.arange(end - max(count, 1), end) for count, end in zip(self.counts, ends, strict=True)]
        found = (np.concatenate([each[k] for k in group.members]) for group in self.groups)
        return [slice(at[0], at[-1] + 1) if at[-1] - at[0] + 1 == at.size else at for at in found]

    def _in_order(self, values: Sequence[Array]) -> Array:
        """Return the values (count,) of all masses in their order, from the values of each group."""
        masses = np.arange(self.drag.size)
        places = np.concatenate([masses[at] for at in self._masses_of_groups()])
        together = jnp.concatenate(values)
        return together if np.array_equal(places, masses) else together[np.argsort(places)]

    def ripple(self, state: Amplitudes) -> Array:
        """Return the amplitude r_j of the vibration of each load's angle that the dropped torque causes, (count,) rad."""
        backward = times(jnp.sum(self.port * self._circle(), axis=1), state.velocity)
        backward = backward if self.levers is None else jnp.sum(self.levers * backward[:, None], axis=0)
        size = magnitude(backward)
        omega = jnp.abs(jnp.mean(state.rate))
        turning = omega > 0.0
        return jnp.where(turning, self.unbalance * size / (8.0 * self.inertia * jnp.where(turning, omega, 1.0)), 0.0)

    def _circle(self) -> Array:
        """Return e, a row for each direction of the mount."""
        if set(self.directions) == {1}:
            return jnp.asarray([_CIRCLE[axis] for axis in self.axes])[None, :, None]
        ways = [self.directions[owner] for owner in self.owners]
        return jnp.asarray([[(1.0, -1j * way)[axis] for axis in self.axes] for way in ways])[:, :, None]


def averaged_loads(scene: Scene) -> CircularLoads:
    """Return the loads of a scene that the averaged equations include. **Raises** `InputError` like `turning_loads`."""
    return turning_loads(scene, AVERAGED_TERMS)


def require_rotating_masses(scene: Scene, included: tuple[type[Term], ...] = AVERAGED_TERMS) -> None:
    """**Raises** `InputError` for an exciter with neither an unbalance nor loads on circles with an ideal drive, and for
    effects with terms that are not `included`."""
    for k, exciter in enumerate(scene.exciters):
        with within(scene.prefix_of(k)):
            if exciter.loads is None:
                continue
            if exciter.unbalance is not None:
                problem = (
                    "is given together with loads; this theory includes only one of them on a rotor: use simulate for both"
                )
                raise InputError("unbalance", problem)
            require_circular(exciter.loads, exciter.drive)
    require_terms(scene.all_effects, included)


def averaged_field(scene: Scene) -> Averaged:
    """Return the averaged equations of `scene`; the module docstring derives them and states their error.

    **Raises** `InputError` like `turning_loads`, for effects other than potentials such as gravity, whose mean torque is 0.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> jam = jv.jam_modes(scene).select(1)
    >>> state = Amplitudes(jam.displacement, 1j * jam.omega * jam.displacement, jam.omega[None], jnp.zeros(1))
    >>> bool(jnp.abs(averaged_field(scene)(0.0, state).rate[0]) < 1e-10)     # a jam is an equilibrium
    True
    """
    averaged_loads(scene)
    return averaged_model(linear_model(scene))


def averaged_model(model: LinearModel) -> Averaged:
    """Return `averaged_field` of a scene that is already assembled and validated."""
    carrier, mounts, exciters = model.carrier, model.mounts, model.scene.exciters
    levers = [_levers(exciter, mount, model.mass.dtype) for exciter, mount in zip(exciters, mounts, strict=True)]
    port = jnp.concatenate([rows[None] for mount in mounts for rows in mount.rows[: len(mount.levers)]])
    n, gyroscopic = carrier.mass.shape[0], mounts[0].gyroscopic
    parts = [carrier.stiffness, carrier.damping, port.reshape(-1, n).T]
    parts += [] if gyroscopic is None else [gyroscopic]
    solved = small_solve(model.mass, jnp.concatenate(parts, axis=1))
    p = port.shape[0] * port.shape[1]
    stiffness, damping = solved[:, :n], solved[:, n : 2 * n]
    solved_gyroscopic = None if gyroscopic is None else solved[:, 2 * n + p :]
    input_matrix = solved[:, 2 * n : 2 * n + p].T.reshape(port.shape)
    owners = tuple(k for k, mount in enumerate(mounts) for _ in mount.levers)
    counts = tuple(0 if exciter.loads is None else exciter.loads.count for exciter in exciters)
    if in_coordinates := len(owners) > n:
        port, input_matrix = _rows_of_masses(levers, port), _rows_of_masses(levers, input_matrix)
        owners = tuple(k for k, each in enumerate(levers) for _ in range(each.shape[1]))
    numbers = (_rotating_masses(exciter, model.mass.dtype) for exciter in exciters)
    unbalance, inertia, drag = (parts[0] if len(parts) == 1 else jnp.concatenate(parts) for parts in zip(*numbers, strict=True))
    return Averaged(
        stiffness=stiffness,
        damping=damping,
        gyroscopic=solved_gyroscopic,
        input_matrix=input_matrix,
        port=port,
        levers=None if in_coordinates else levers[0] if len(levers) == 1 else _block_diagonal(levers),
        unbalance=unbalance,
        inertia=inertia,
        drag=drag,
        groups=grouped([exciter.drive for exciter in exciters], counts),
        axes=mounts[0].axes,
        counts=counts,
        directions=tuple(exciter.direction for exciter in exciters),
        owners=owners,
    )


def _levers(exciter: Exciter, mount: Mount, dtype: jnp.dtype) -> Array:
    """Return the levers (levers, count) of the rotating masses of an exciter."""
    one = jnp.ones((1, 1 if exciter.loads is None else exciter.loads.count), dtype=dtype)
    return jnp.concatenate([one if lever is None else lever[None] for lever in mount.levers])


def _rotating_masses(exciter: Exciter, dtype: jnp.dtype) -> tuple[Array, Array, Array]:
    """Return unbalances S, inertias I and drags D (count,) of the rotating masses of an exciter."""
    if exciter.loads is None:
        motor = exciter.drive.torque_and_inertia(jnp.asarray(LATE), exciter.drive.speed)
        numbers = exciter.unbalance, jnp.inf if motor is None else motor[1], 0.0
        unbalance, inertia, drag = (jnp.reshape(jnp.asarray(x, dtype), (1,)) for x in numbers)
        return unbalance, inertia, drag
    loads = cast(CircularLoads, exciter.loads)

    def each(value: Array) -> Array:
        return jnp.broadcast_to(value, (loads.count,))

    unbalance = each(loads.mass * loads.radius)
    inertia = each(loads.inertia_factor() * loads.mass * loads.radius**2)
    return unbalance, inertia, each(loads.drag * loads.radius**2)


def _rows_of_masses(levers: Sequence[Array], rows: Array) -> Array:
    """Return the rows (count, p, nd) of all masses from those of the exciters' levers (levers, p, nd)."""
    each = jnp.split(rows, np.cumsum([len(of_exciter) for of_exciter in levers])[:-1])
    return jnp.concatenate([jnp.einsum("lj,lpa->jpa", *pair, precision="highest") for pair in zip(levers, each, strict=True)])


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    width = sum(block.shape[1] for block in blocks)
    begins = np.cumsum([0, *(block.shape[1] for block in blocks)])
    rows = [jnp.pad(b, ((0, 0), (at, width - at - b.shape[1]))) for b, at in zip(blocks, begins, strict=False)]
    return jnp.concatenate(rows)


def averaged_growth(field: Averaged, omega: Array, phase: Array, displacement: Array, neutral: Array | int = 1) -> Array:
    """Return the growth rate of small disturbances of rotating masses that turn at one speed, 1/s: the `largest_growth` of the
    averaged equations, linearized about the motion; NaN if the motion is not finite, and if rounding errors of the fastest rate
    of a rotating mass, such as that of a motor of 1e20 N m, exceed `omega`.

    **Arguments**: `omega` rad/s; `phase` (count,) rad; `displacement` (nd,) complex, m, as in `Amplitudes`; `neutral`: 1 for a
    common shift of all phases, and one more for each free parameter of a continuous family of motions.
    """
    nd, count = displacement.shape[0], phase.shape[0]
    free = np.flatnonzero(~field.is_prescribed)

    def flow(x: Array) -> Array:
        y = x[: 2 * nd] + 1j * x[2 * nd : 4 * nd]
        w, psi = x[4 * nd : 4 * nd + free.size], x[4 * nd + free.size :]
        rate = w if free.size == count else jnp.full_like(psi, omega).at[free].set(w)
        change = field(jnp.full_like(omega, LATE), Amplitudes(y[:nd], y[nd:], rate, psi))
        rates = jnp.concatenate([change.displacement, change.velocity])
        return jnp.concatenate([rates.real, rates.imag, change.rate[free], change.phase])

    y = jnp.concatenate([displacement, 1j * omega * displacement])
    matrix = jax.jacfwd(flow)(jnp.concatenate([y.real, y.imag, jnp.full_like(phase[free], omega), phase]))
    rates = jnp.arange(4 * nd, 4 * nd + free.size)
    rounding = jnp.finfo(omega.dtype).eps * jnp.max(jnp.abs(matrix[rates, rates]), initial=0.0)
    return jnp.where(rounding < omega, largest_growth(matrix, neutral), jnp.nan)


def decays(growth: Array, omega: Array) -> Array:
    """Return True if disturbances with a growth rate, 1/s, of a motion at the speed `omega`, rad/s, decay, see
    `_MIN_DAMPING`."""
    return growth < -max(_MIN_DAMPING, 100.0 * float(jnp.finfo(growth.dtype).eps)) * omega


def largest_growth(matrix: Array, neutral: Array | int) -> Array:
    """Return the largest real part of the eigenvalues of a matrix, 1/s, without the `neutral` ones closest to 0; NaN if the
    matrix is not finite."""
    # The library routine for eigenvalues does not terminate for a matrix that is not finite.
    finite = jnp.all(jnp.isfinite(matrix))
    values = eigenvalues_in_turn(jnp.where(finite, matrix, 0.0))
    rank = jnp.argsort(jnp.argsort(jnp.abs(values)))
    growth = jnp.max(jnp.where(rank < neutral, -jnp.inf, values.real))
    return jnp.where(finite, growth, jnp.nan)


def rotating_angles(scene: Scene, state: State) -> tuple[Array, Array]:
    """Return the angles (count,) rad and rates, rad/s, of all rotating masses at t = 0, in their directions of rotation."""
    each = []
    for exciter, part in zip(scene.exciters, state.exciters, strict=True):
        if part.angle:
            angle, rate = part.angle[0], part.rate[0]
        else:
            drive, start = exciter.turning_drive, jnp.zeros_like(exciter.drive.speed)
            angle, rate = drive.rotor_angle(start, part.rotor)[None], drive.rotor_speed(start, part.rotor)[None]
        each.append((angle, rate) if exciter.direction == 1 else (-angle, -rate))
    if len(each) == 1:
        return each[0]
    angles, rates = zip(*each, strict=True)
    return jnp.concatenate(angles), jnp.concatenate(rates)


def amplitudes_of(scene: Scene, state: State) -> Amplitudes:
    """Return the amplitudes of a state of the full equations: Re Y e^{i theta} = q, Re V e^{i theta} = q'.

    The state determines only these real parts. The imaginary parts follow from the assumption that the carrier vibrates at the
    loads' mean speed. Loads that turn at less than half the lowest natural frequency cannot have caused the vibration. The
    carrier is then assumed to vibrate freely at its natural frequencies. Each load's rate is used as its mean rate.
    """
    angle, rate = rotating_angles(scene, state)
    model = linear_model(scene)
    frequencies, shapes = model.modes()
    omega, theta = jnp.mean(rate), jnp.mean(angle)
    is_elastic = frequencies > 0.0
    is_slow = jnp.abs(omega) < 0.5 * jnp.min(jnp.where(is_elastic, frequencies, jnp.inf))
    periods = jnp.where(is_elastic, 1.0 / jnp.where(is_elastic, frequencies, 1.0), 0.0)
    to_modal = shapes.T @ model.mass
    turning = jnp.where(is_slow, 1.0, omega)
    # A quarter of a period later, the displacement is q'/w, and the velocity is -w q.
    later_displacement = jnp.where(is_slow, shapes @ (periods * (to_modal @ state.velocity)), state.velocity / turning)
    w_times_q = jnp.where(is_slow, shapes @ (frequencies * (to_modal @ state.displacement)), turning * state.displacement)
    back = jnp.exp(-1j * theta)
    displacement = back * (state.displacement - 1j * later_displacement)
    velocity = back * (state.velocity + 1j * w_times_q)
    return Amplitudes(displacement, velocity, rate, angle - theta)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _with_conjugate(a: Array, b: Array, right: Array) -> Array:
    """Return x of a x + b conj(x) = right: in closed form for one unknown, otherwise from twice as many real equations."""
    if right.shape[0] == 1:
        a, b = a[0], b[0]
        return (jnp.conj(a) * right - b * jnp.conj(right)) / (a.real**2 + a.imag**2 - b.real**2 - b.imag**2)
    top = jnp.concatenate([a.real + b.real, b.imag - a.imag], axis=1)
    bottom = jnp.concatenate([a.imag + b.imag, a.real - b.real], axis=1)
    x = times(unrolled_inverse(jnp.concatenate([top, bottom])), jnp.concatenate([right.real, right.imag]))
    n = right.shape[0]
    return x[:n] + 1j * x[n:]
