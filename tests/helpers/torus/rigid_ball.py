"""A rigid ball in a turning tube by Newton's and Euler's equations in space, in NumPy: no coordinates of the torus, no rolling
put in by hand. Its state is the place and velocity of its centre and its angular velocity."""

import numpy as np
from scipy.integrate import solve_ivp

AXIS = np.array([0.0, 0.0, 1.0])


class RigidBall:
    def __init__(self, mass, own, ring, gap, speed, gravity):
        self.m, self.r, self.ring, self.gap, self.w, self.g = mass, own, ring, gap, speed, gravity
        self.inertia = 0.4 * mass * own**2

    def normal(self, x, v):
        """Unit vector from the centre line of the tube through the centre of the ball, and its rate."""
        h = np.hypot(x[0], x[1])
        out = np.array([x[0] / h, x[1] / h, 0.0])
        rise = out @ v
        turn = (np.array([v[0], v[1], 0.0]) - rise * out) / h
        return ((h - self.ring) * out + x[2] * AXIS) / self.gap, (rise * out + (h - self.ring) * turn + v[2] * AXIS) / self.gap

    def slip(self, y):
        x, v, turning = y[:3], y[3:6], y[6:]
        n, _ = self.normal(x, v)
        return v + self.r * np.cross(turning, n) - self.w * np.cross(AXIS, x + self.r * n)

    def rolling(self, t, y):
        """The contact force is what keeps the slip's rate 0, all of its three components."""
        x, v, turning = y[:3], y[3:6], y[6:]
        n, dn = self.normal(x, v)

        def slip_rate(force):
            a, change = force / self.m - self.g * AXIS, self.r * np.cross(n, force) / self.inertia
            return a + self.r * (np.cross(change, n) + np.cross(turning, dn)) - self.w * np.cross(AXIS, v + self.r * dn)

        at_none = slip_rate(np.zeros(3))
        force = np.linalg.solve(np.stack([slip_rate(unit) - at_none for unit in np.eye(3)], axis=1), -at_none)
        return np.concatenate([v, force / self.m - self.g * AXIS, self.r * np.cross(n, force) / self.inertia])

    def sliding(self, coefficient):
        def rates(t, y):
            x, v = y[:3], y[3:6]
            n, dn = self.normal(x, v)
            pressed = self.m * (dn @ v - self.g * n[2])
            slip = self.slip(y)
            force = -pressed * n - coefficient * pressed * slip / np.linalg.norm(slip)
            return np.concatenate([v, force / self.m - self.g * AXIS, self.r * np.cross(n, force) / self.inertia])

        return rates

    def ends(self, y, until, coefficient=None):
        """The state at the end, and when the ball began to roll."""
        begun, tight = 0.0, dict(method="DOP853", rtol=1e-11, atol=1e-12)
        if coefficient is not None:

            def stops(t, y):
                return np.linalg.norm(self.slip(y)) - 1e-4

            stops.terminal = True
            found = solve_ivp(self.sliding(coefficient), (0.0, until), y, events=stops, **tight)
            begun, y = found.t[-1], found.y[:, -1]
            if begun < until:  # what is left of the slip would stay, and carry the ball off the wall
                y[6:] -= np.cross(self.normal(y[:3], y[3:6])[0], self.slip(y)) / self.r
        if begun < until:
            y = solve_ivp(self.rolling, (begun, until), y, **tight).y[:, -1]
        return y, begun

    def state(self, f, a, turn, climb):
        """Place and velocity of the centre."""
        arm, out, along = self.ring + self.gap * np.sin(a), np.array([np.cos(f), np.sin(f), 0.0]), [-np.sin(f), np.cos(f), 0.0]
        x = arm * out - self.gap * np.cos(a) * AXIS
        return x, arm * turn * np.array(along) + self.gap * climb * (np.cos(a) * out + np.sin(a) * AXIS)

    def coordinates(self, y):
        """f', a', B cos f, B sin f, a, and the spin about the normal relative to the wall."""
        x, v, turning = y[:3], y[3:6], y[6:]
        n, _ = self.normal(x, v)
        h = np.hypot(x[0], x[1])
        a = np.arctan2(h - self.ring, -x[2])
        turn = (x[0] * v[1] - x[1] * v[0]) / h**2
        climb = (np.cos(a) * (x[:2] @ v[:2]) / h + np.sin(a) * v[2]) / self.gap
        return np.array([turn, climb, x[0], x[1], a, (turning - self.w * AXIS) @ n])
