"""The slew as an optimal control problem whose limits hold everywhere, not at nodes only.

Stage k holds the state z_k = (sigma, rate, acceleration, T) and the jerk u_k, constant in the interval of length
h_k T; the h_k are given fractions. T is the same in all stages, kept as a state so that every stage couples with its
neighbour only. Attitudes are modified Rodrigues parameters against the attitude half-way round, propagated by the
sixth-order Magnus expansion. With constant jerk

- the acceleration is linear in the interval and its norm is largest at a node,
- the rate is quadratic and lies in the hull of its Bezier control points: with b = w_k + h eps_k / 2 the two inner
  points of the halved interval, (w_k + b) / 2 = w_k + h eps_k / 4 and (b + w_(k+1)) / 2 = w_k + 3 h eps_k / 4
  + h^2 u / 4, are kept in the ball, and since the acceleration is continuous the nodes lie between two such points.

Keep-out cones and the envelopes of torque and momentum are kept at the nodes with a margin that the caller enlarges
until a dense check between the nodes is content (:mod:`guidance.slew`).

The derivatives of one stage come from small compiled kernels; they are mapped over the stages and scattered into the
sparse matrices of the solver, so that nothing the size of the whole problem is ever compiled.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from estimator.models import rotations
from estimator.models.compiled import compiled

Array = np.ndarray

STATE, CONTROL = 10, 3
STAGE = STATE + CONTROL


@dataclass(frozen=True)
class Extras:
    """What is limited besides rate, acceleration and jerk.

    Attributes:
        cones: number of keep-out cones.
        torque: number of numbers that limit the torque: 0, 1 (sphere) or 3 (box).
        momentum: the same for the momentum of the actuators, or 4 for the cluster of two scissored pairs.
    """

    cones: int = 0
    torque: int = 0
    momentum: int = 0

    @property
    def rows(self) -> int:
        """Number of additional rows of a stage."""
        return self.cones + self.torque + self.momentum

    @property
    def names(self) -> list[str]:
        """What the additional rows limit, in order."""
        momentum = {0: 0, 1: 1, 3: 3, 4: 4}[self.momentum]
        return ["keep-out cone"] * self.cones + ["torque"] * self.torque + ["momentum"] * momentum

    @property
    def parameters(self) -> int:
        """Length of :func:`extra_rows`'s parameter: cones (7 each), inertia, total momentum, torque, momentum."""
        return 7 * self.cones + (9 + 3 + 3 + 3 if self.torque or self.momentum else 0)


def propagate(sigma: Any, w: Any, a: Any, j: Any, h: Any) -> Any:
    """Modified Rodrigues parameters after a step of length h with rate w + a t + j t^2 / 2.

    The sixth-order Magnus expansion of ``guidance.jerk_profile.magnus_rotation``; tan(x)/x by its continued fraction.
    """
    m1 = h * (w + a * h / 2 + j * h * h / 8)
    m2 = h * h * (a + j * h / 2)
    m3 = h * h * h * j / 2
    c1 = ca.cross(m1, m2)
    c2 = ca.cross(m1, 2 * m3 - c1) / 60
    phi = m1 + m3 / 12 + ca.cross(20 * m1 + m3 + c1, m2 + c2) / 240
    x2 = ca.sumsqr(phi) / 16
    b = phi / 4 / (1 - x2 / (3 - x2 / (5 - x2 / (7 - x2 / (9 - x2 / 11)))))
    s2, b2 = ca.sumsqr(sigma), ca.sumsqr(b)
    return ((1 - s2) * b + (1 - b2) * sigma + 2 * ca.cross(sigma, b)) / (1 + s2 * b2 - 2 * ca.dot(sigma, b))


def extra_rows(extras: Extras, sigma: Any, w: Any, a: Any, e: Any) -> Any:
    """Rows, each at most zero, that keep cones, torque and momentum; all in SI.

    Args:
        extras: which rows.
        sigma: attitude ``reference_from_body``.
        w, a: rate and acceleration, body axes.
        e: per cone the direction in the reference frame (3), the axis in the body (3), the cosine of the half angle
            (1); then inertia (9), total momentum in the reference frame (3), torque limits (3), momentum limits (3).
    """
    s2 = ca.sumsqr(sigma)
    q = ca.vertcat(1 - s2, 2 * sigma) / (1 + s2)
    rows = []
    for i in range(extras.cones):
        cone = e[7 * i:7 * i + 7]
        rows.append(ca.dot(cone[0:3], rotations.rotate(q, cone[3:6])) - cone[6])
    if extras.torque or extras.momentum:
        rest = e[7 * extras.cones:]
        inertia = ca.reshape(rest[0:9], 3, 3)
        total = rotations.rotate(rotations.conjugate(q), rest[9:12])
        torque_limit, momentum_limit = rest[12:15], rest[15:18]
        torque = inertia @ a + ca.cross(w, total)
        momentum = total - inertia @ w
        if extras.torque == 1:
            rows.append(ca.sumsqr(torque) / torque_limit[0] ** 2 - 1)
        elif extras.torque == 3:
            rows.append((torque / torque_limit) ** 2 - 1)
        if extras.momentum == 1:
            rows.append(ca.sumsqr(momentum) / momentum_limit[0] ** 2 - 1)
        elif extras.momentum == 3:
            rows.append((momentum / momentum_limit) ** 2 - 1)
        elif extras.momentum == 4:
            # |x| <= sqrt(4 - y^2) + sqrt(4 - z^2), |y| <= 2, |z| <= 2; the root is rounded off at its end.
            h = momentum / momentum_limit[0]

            def root(v: Any) -> Any:
                r = 4 - v * v
                return ca.sqrt((r + ca.sqrt(r * r + 1e-6)) / 2) - 5e-4

            reach = root(h[1]) + root(h[2])
            rows += [h[0] - reach, -h[0] - reach, h[1] ** 2 / 4 - 1, h[2] ** 2 / 4 - 1]
    return ca.vertcat(*rows) if rows else ca.SX(0, 1)


@dataclass(frozen=True)
class Kernel:
    """Rows of one stage with their derivatives with respect to its local unknowns x = (z_k, u_k, z_(k+1)).

    ``rows(x, q, p) -> cost, g``; ``jacobian(x, q, p) -> g, nonzeros``; ``hessian(x, q, p, lam, weight) -> nonzeros`` of
    the upper triangle; ``gradient(x, q, p) -> cost, gradient``. q is the stage's own data, p is shared.
    """

    rows: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    gradient: ca.Function
    jacobian_index: tuple[Array, Array]
    hessian_index: tuple[Array, Array]
    height: int


FIXED_SHARED = 8
PATH = 4
ROW_NAMES = ("jerk", "acceleration", "rate", "rate")


@functools.cache
def stage_kernel(extras: Extras) -> Kernel:
    """The kernel of a stage.

    Own data: length of the interval as a fraction of the whole, and 1 where the additional rows hold (0 at the start,
    which is given). Shared: scales of sigma, rate, acceleration, time (s); limits of rate, acceleration and jerk
    (SI); 1 for the smoothest slew, 0 for the shortest; then the parameters of the additional rows.
    """
    x, q = ca.SX.sym("x", STAGE + STATE), ca.SX.sym("q", 2)
    p = ca.SX.sym("p", FIXED_SHARED + extras.parameters)
    s0, w0, a0, t, u, z1 = x[0:3], x[3:6], x[6:9], x[9], x[10:13], x[13:23]
    angle, rate, acceleration, unit = p[0], p[1], p[2], p[3]
    rate_limit, acceleration_limit, jerk_limit, smooth = p[4], p[5], p[6], p[7]
    h = q[0] * t * unit
    w, a, j = rate * w0, acceleration * a0, jerk_limit * u
    g = ca.vertcat(
        z1[0:3] - propagate(angle * s0, w, a, j, h) / angle,
        z1[3:6] - (w + h * a + h * h / 2 * j) / rate,
        z1[6:9] - (a + h * j) / acceleration,
        z1[9] - t,
        ca.sumsqr(u) - 1,
        ca.sumsqr(a + h * j) / acceleration_limit**2 - 1,
        ca.sumsqr(w + h * a / 4) / rate_limit**2 - 1,
        ca.sumsqr(w + 3 * h * a / 4 + h * h * j / 4) / rate_limit**2 - 1,
    )
    if extras.rows:
        # Where the row does not hold it is the constant -1.
        g = ca.vertcat(g, q[1] * extra_rows(extras, angle * s0, w, a, p[FIXED_SHARED:]) - (1 - q[1]))
    cost = smooth * q[0] * ca.sumsqr(u) + (1 - smooth) * q[0] * t
    lam, weight = ca.SX.sym("lam", g.shape[0]), ca.SX.sym("weight")
    jacobian = ca.jacobian(g, x)
    hessian = ca.triu(ca.hessian(weight * cost + ca.dot(lam, g), x)[0])
    name = f"slew_{extras.cones}_{extras.torque}_{extras.momentum}"

    def function(kind: str, more: list[ca.SX], outs: list[ca.SX]) -> ca.Function:
        ins = [x, q, p, *more]
        return compiled(ca.Function(f"{name}_{kind}", ins, [ca.densify(o) for o in outs],
                                    [f"i{k}" for k in range(len(ins))], [f"o{k}" for k in range(len(outs))]))

    def index(matrix: ca.SX) -> tuple[Array, Array]:
        rows, columns = matrix.sparsity().get_triplet()
        return np.array(rows, dtype=int), np.array(columns, dtype=int)

    return Kernel(function("rows", [], [cost, g]),
                  function("jacobian", [], [g, jacobian.nz[:]]),
                  function("hessian", [lam, weight], [hessian.nz[:]]),
                  function("gradient", [], [cost, ca.gradient(cost, x)]),
                  index(jacobian), index(hessian), int(g.shape[0]))


def _scatter(rows: Array, columns: Array, height: int, width: int) -> tuple[ca.Sparsity, ca.DM]:
    """Pattern of the sum of entries (rows, columns), and the matrix from the entries to its nonzeros."""
    key = columns * height + rows
    unique, inverse = np.unique(key, return_inverse=True)
    pattern = ca.Sparsity.triplet(height, width, [int(v) for v in unique % height], [int(v) for v in unique // height])
    order = ca.DM.triplet([int(v) for v in inverse], list(range(len(key))), ca.DM.ones(len(key)), len(unique), len(key))
    return pattern, order


class Transcription:
    """Sparse problem functions for n intervals.

    Unknowns: z_0, u_0, z_1, u_1, ..., z_n. Parameters: those shared by the stages, then the own data of the stages
    (2 each). Rows: per stage the ten of the dynamics, the four of the limits, the additional ones.
    """

    def __init__(self, count: int, extras: Extras):
        n = self.count = count
        self.extras = extras
        kernel = stage_kernel(extras)
        self.height = kernel.height
        self.size = STAGE * n + STATE
        self.shared = FIXED_SHARED + extras.parameters
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.shared + 2 * n)
        shared, own = p[:self.shared], ca.reshape(p[self.shared:], 2, n)
        columns = STAGE * np.arange(n)[:, None] + np.arange(STAGE + STATE)
        local = ca.horzcat(*[x[STAGE * k:STAGE * k + STAGE + STATE] for k in range(n)])

        def spread(function: ca.Function, reduce: tuple[int, ...] = (2,)) -> ca.Function:
            return function.map(f"{function.name()}_{n}", "serial", n, list(reduce), [])

        cost, g = spread(kernel.rows)(local, own, shared)
        f, g = ca.sum2(cost), ca.vec(g)
        height = kernel.height * n
        rows = (kernel.height * np.arange(n)[:, None] + kernel.jacobian_index[0]).ravel()
        pattern, order = _scatter(rows, columns[:, kernel.jacobian_index[1]].ravel(), height, self.size)
        g_again, values = spread(kernel.jacobian)(local, own, shared)
        jacobian = ca.MX(pattern, ca.mtimes(order, ca.vec(values)))
        _, gradients = spread(kernel.gradient)(local, own, shared)
        gather = ca.DM.triplet([int(v) for v in columns.ravel()], list(range(columns.size)), ca.DM.ones(columns.size),
                               self.size, columns.size)
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", height)
        pattern, order = _scatter(columns[:, kernel.hessian_index[0]].ravel(),
                                  columns[:, kernel.hessian_index[1]].ravel(), self.size, self.size)
        values = spread(kernel.hessian, (2, 4))(local, own, shared, ca.reshape(lam_g, kernel.height, n), lam_f)
        hessian = ca.MX(pattern, ca.mtimes(order, ca.vec(values)))
        self.problem = {"x": x, "p": p, "f": f, "g": g}
        self.rows = ca.Function("slew_rows", [x, p], [g])
        gradient = ca.densify(ca.mtimes(gather, ca.vec(gradients)))
        both = ca.Function("nlp_jac_g", [x, p], [ca.vec(g_again), jacobian], ["x", "p"], ["g", "jac_g_x"])
        self._derivatives: dict[str, dict[str, Any]] = {
            "ipopt": {
                "grad_f": ca.Function("nlp_grad_f", [x, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
                "jac_g": both,
                "hess_lag": ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [hessian], ["x", "p", "lam_f", "lam_g"],
                                        ["triu_hess_gamma_x_x"]),
            },
            # This plugin has no options for them: it finds them by name among the functions that it would make.
            "fatrop": {"no_nlp_grad": False, "cache": {
                "nlp_grad": ca.Function(
                    "nlp_grad", [x, p, lam_f, lam_g],
                    [f, g, lam_f * gradient + ca.densify(ca.mtimes(jacobian.T, lam_g)), ca.MX.zeros(p.shape)],
                    ["x", "p", "lam_f", "lam_g"], ["f", "g", "grad_gamma_x", "grad_gamma_p"]),
                "nlp_grad_f": ca.Function("nlp_grad_f", [x, p], [gradient], ["x", "p"], ["grad_f_x"]),
                "nlp_jac_g": both,
                "nlp_hess_l": ca.Function(
                    "nlp_hess_l", [x, p, lam_f, lam_g],
                    [lam_f * gradient + ca.densify(ca.mtimes(jacobian.T, lam_g)), ca.triu2symm(hessian)],
                    ["x", "p", "lam_f", "lam_g"], ["grad_gamma_x", "hess_gamma_x_x"]),
            }},
        }
        inequalities = kernel.height - STATE
        self.lbg = np.tile(np.concatenate([np.zeros(STATE), np.full(inequalities, -np.inf)]), n)
        self.ubg = np.zeros(height)
        self._solvers: dict[tuple[Any, ...], ca.Function] = {}

    def solver(self, name: str = "ipopt", **options: Any) -> ca.Function:
        """The solver of that name with the given options besides the defaults, made once."""
        key = (name, *sorted(options.items()))
        if key not in self._solvers:
            settings: dict[str, Any] = {"print_time": False, "error_on_fail": False, "no_nlp_grad": True,
                                        "calc_lam_p": False, **self._derivatives[name]}
            if name == "ipopt":
                settings |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8, "ipopt.max_iter": 250,
                             "ipopt.nlp_scaling_method": "none"}
                if not self.extras.rows:
                    # The unknowns are scaled and the pattern is a narrow band: nothing is gained by scaling, matching
                    # and ordering again in the linear solver, or by refining its steps; it costs a sixth of the time.
                    settings |= {"ipopt.mumps_scaling": 0, "ipopt.mumps_permuting_scaling": 0,
                                 "ipopt.mumps_pivot_order": 0, "ipopt.fast_step_computation": "yes"}
            else:
                n, extra = self.count, self.height - STATE
                settings |= {"structure_detection": "manual", "N": n, "nx": [STATE] * (n + 1),
                             "nu": [CONTROL] * n + [0], "ng": [extra] * n + [0],
                             "equality": ([True] * STATE + [False] * extra) * n,
                             "fatrop.print_level": 0, "fatrop.tolerance": 1e-6, "fatrop.mu_init": 1e-2,
                             "fatrop.max_iter": 150}
            self._solvers[key] = ca.nlpsol("slew", name, self.problem, settings | options)
        return self._solvers[key]


@functools.lru_cache(maxsize=32)
def transcription(count: int, extras: Extras) -> Transcription:
    """The transcription of a number of intervals, made once."""
    return Transcription(count, extras)
