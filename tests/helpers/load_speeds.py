"""Leading-order jams from the designer's numbers by NumPy: complex responses and every root of a polynomial."""

import itertools

import numpy as np
from numpy.polynomial import polynomial as poly


def matrices(s):
    """Mass with the loads, damping, stiffness and the exciter's index, from the designer's numbers alone."""
    m = s.machine
    mass = np.diag(np.asarray(m.mass))
    mass[m.exciter - 1, m.exciter - 1] += np.sum(np.broadcast_to(np.asarray(s.loads.mass), (s.loads.count,)))
    out = [mass]
    for support, link in ((m.damping, m.link_damping), (m.stiffness, m.link_stiffness)):
        matrix = np.diag(np.asarray(support)).astype(float)
        for (i, j), value in zip(m.links, np.asarray(link), strict=True):
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                matrix[a - 1, b - 1] += sign * value
        out.append(matrix)
    return (*out, m.exciter - 1)


def unbalance_and_drag(s):
    n = s.loads.count
    mass, radius, drag = (np.broadcast_to(np.asarray(x), (n,)) for x in (s.loads.mass, s.loads.radius, s.loads.drag))
    return np.sum(mass * radius), np.sum(drag * radius**2)


def complex_response(s, w):
    """Complex amplitudes in NumPy, of platforms and of the foundation force; `w`: a speed or an array of speeds."""
    mass, damping, stiffness, port = matrices(s)
    rotation = np.asarray(w)[..., None]
    force = np.zeros((*np.shape(w), len(mass)), complex)
    force[..., port] = -1j * unbalance_and_drag(s)[0] * np.asarray(w) ** 2
    dynamic = stiffness - rotation[..., None] ** 2 * mass + 1j * rotation[..., None] * damping
    y = np.linalg.solve(dynamic, force[..., None])[..., 0]
    return y, np.sum((np.asarray(s.machine.stiffness) + 1j * rotation * np.asarray(s.machine.damping)) * y, axis=-1)


def determinant(matrix):
    """Determinant of a matrix of polynomials, by permutations."""
    n, total = len(matrix), np.zeros(1, complex)
    for order in itertools.permutations(range(n)):
        term = np.array([(-1.0) ** sum(a > b for a, b in itertools.combinations(order, 2))], complex)
        for i, j in enumerate(order):
            term = poly.polymul(term, matrix[i][j])
        total = poly.polyadd(total, term)
    return total


def all_load_speeds(s):
    """Every positive real root of P(w) = 2 drag (n - w) |det|^2 + S^2 w^4 Im(minor conj(det)), ascending."""
    mass, damping, stiffness, port = matrices(s)
    n, speed, (total, drag) = len(mass), float(s.drive.speed), unbalance_and_drag(s)
    dynamic = [[np.array([stiffness[i, j], 1j * damping[i, j], -mass[i, j]]) for j in range(n)] for i in range(n)]
    det = determinant(dynamic)
    minor = determinant([[dynamic[i][j] for j in range(n) if j != port] for i in range(n) if i != port])
    balance = 2.0 * drag * poly.polymul([speed, -1.0], poly.polymul(det, det.conj()).real)
    balance = poly.polyadd(balance, poly.polymul([0, 0, 0, 0, total**2], poly.polymul(minor, det.conj()).imag))
    scaled = balance * speed ** np.arange(len(balance))  # the variable is w/n: coefficients of one size
    roots = poly.polyroots(scaled / np.max(np.abs(scaled)))
    return np.sort(roots[(np.abs(roots.imag) < 1e-6 * np.abs(roots)) & (roots.real > 0.0)].real) * speed
