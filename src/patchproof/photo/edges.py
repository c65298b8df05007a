"""Measure the straight black-to-white borders of markers to a fraction of a pixel, in linear light.

In: linear luminance, rough corners and the printed cells. Out: for each marker the corners where its four fitted
borders meet, and the blur of those borders. The model is a border blurred by a Gaussian σ, with the black rim one
module m wide and the cells behind it known (q is their blurred row, 1 = paper):

    light(s, t) = black + (white - black) · [Φ(u / σ) + q(s) · Φ(-(u + m) / σ)],   u = t - d - a·s

s along the border in [-1, 1], t outwards in px; fitted by damped Gauss-Newton over all borders at once. Linear light,
because a lens blurs light and not code values. Stretches that do not follow the model (a thumb, a glare) are excluded.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

# 49 points of a rectangle, including its border, as shares of its width and height
RECT_GRID = np.stack(np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7)), -1).reshape(-1, 2)
ALONG, ACROSS = 24, 19  # samples per border: 24 stretches of 19
BORDER_SHARE = 0.87  # of a border that is sampled: nearer to its ends the next border's blur mixes in
# range of samples in modules: inwards the printed cells are known, outwards only one module of paper
INWARD_MODULES, OUTWARD_MODULES = 1.0, 0.6
# Range to either side in units of the fitted blur, at least in px. The light is flat beyond it, where samples a pixel
# apart would move a sharp border by 0.1 px.
RANGE_SIGMAS, LEAST_RANGE_PX = 4.0, 2.5
# blur that sampling adds: a pixel's own width (1/12 px²) and bilinear interpolation (mean over phases 1/6 px²)
_SAMPLING_VARIANCE = 1 / 12 + 1 / 6
_MAX_STEPS, _CONVERGED_PX = (6, 5), (0.02, 1e-3)  # the first round only determines where the second one samples


@dataclass(frozen=True)
class Borders:
    """The borders of a marker: corners 4×2 px, Gaussian blur (0 if sharper than the pixels), the side of a module."""

    corners_px: np.ndarray
    blur_px: float
    module_px: float
    fitted: bool  # False: the borders could not be fitted, the corners are the rough ones


def fit_borders(luminance: np.ndarray, corners_px: np.ndarray, cells: np.ndarray) -> list[Borders]:
    """Fit all borders of M×4×2 rough corners (clockwise); `cells` M×n×n are the modules, rim included, 1 = paper."""
    rough, modules = np.asarray(corners_px, float), cells.shape[1]
    # the row of cells behind each border, M×4×n
    inner_cells = np.stack([cells[:, 1], cells[:, :, -2], cells[:, -2, ::-1], cells[:, ::-1, 1]], 1)
    corners, fitted = rough, np.zeros(len(rough), bool)
    sigma, range_px = np.zeros((len(rough), 4)), np.full((len(rough), 4), np.inf)
    for converged_px in _CONVERGED_PX:  # the second round samples about the first one's borders, no farther than needed
        intersections, fitted, sigma = _fit_round(luminance, corners, inner_cells, range_px, converged_px)
        shift = np.linalg.norm(intersections - rough, axis=2).max(1)
        fitted &= shift < 1.0 + OUTWARD_MODULES * _module_px(rough, modules).max(1)
        corners = np.where(fitted[:, None, None], intersections, rough)
        range_px = np.where(fitted[:, None], np.maximum(RANGE_SIGMAS * sigma, LEAST_RANGE_PX), np.inf)
    blur_px = np.sqrt(np.maximum(0.0, np.median(sigma, 1) ** 2 - _SAMPLING_VARIANCE)).tolist()
    module_px = np.sqrt(_module_px(corners, modules)[:, :2].prod(1)).tolist()
    return [Borders(*marker) for marker in zip(corners, blur_px, module_px, fitted.tolist(), strict=True)]


def sample(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate H×W or H×W×C bilinearly at `... × 2` pixel positions (centers at .5); border pixels are repeated."""
    yx = [points[..., 1] - 0.5, points[..., 0] - 0.5]
    if image.ndim == 2:
        return map_coordinates(image, yx, order=1, mode="nearest")
    return np.stack([map_coordinates(image[..., c], yx, order=1, mode="nearest") for c in range(image.shape[2])], -1)


def border_frame(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The middle, half-length vector and outward unit normal (each M×4×2) of the borders of clockwise corners."""
    start, end = corners, np.roll(corners, -1, axis=1)
    half = (end - start) / 2
    normal = np.stack([half[..., 1], -half[..., 0]], -1)
    return (start + end) / 2, half, normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _module_px(corners: np.ndarray, modules: int) -> np.ndarray:
    """Module size M×4 across each border: the mean depth of the quadrilateral behind it, by the number of modules."""
    middle, _, normal = border_frame(corners)
    depth = np.einsum("mij,mij->mi", middle - np.roll(middle, -2, axis=1), normal)
    return np.maximum(depth, 1e-3) / modules


def _fit_round(luminance, corners, inner_cells, range_px, converged_px):
    middle, half, normal = border_frame(corners)
    module = _module_px(corners, inner_cells.shape[2])
    inward = np.clip(INWARD_MODULES * module, 1.2, np.minimum(range_px, 12.0))
    outward = np.clip(OUTWARD_MODULES * module, 1.0, np.minimum(range_px, 10.0))
    s = np.linspace(-BORDER_SHARE, BORDER_SHARE, ALONG)
    t = np.linspace(-inward, outward, ACROSS, axis=-1)  # M×4×ACROSS
    points = (
        middle[:, :, None, None]
        + s[:, None, None] * half[:, :, None, None]
        + t[:, :, None, :, None] * normal[:, :, None, None]
    )
    light = sample(luminance, points)
    count = len(corners) * 4
    half_px = np.linalg.norm(half, axis=-1)
    model = _BorderModel(s, t.reshape(count, ACROSS), module.ravel(), half_px.ravel(), inner_cells.reshape(count, -1))
    fit = _fit_parameters(light.reshape(count, ALONG, ACROSS), model, converged_px)
    d, a, sigma, black, white = (fit[:, i].reshape(-1, 4) for i in range(5))
    ends = [middle + sign * half + (d + sign * a)[..., None] * normal for sign in (-1, 1)]
    fitted = (white - black > 0.01).all(1) & (np.abs(d) < outward).all(1) & np.isfinite(fit).reshape(-1, 20).all(1)
    return intersect_borders(*ends), fitted, sigma


def intersect_borders(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Intersect each border with the previous one: corners M×4×2 from the borders' end points."""
    p, u = start, end - start
    q, v = np.roll(start, 1, axis=1), np.roll(u, 1, axis=1)
    cross = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
    gap = q - p
    along = (gap[..., 0] * v[..., 1] - gap[..., 1] * v[..., 0]) / cross
    return p + along[..., None] * u


@dataclass(frozen=True)
class _BorderModel:
    """The model of K sampled borders: s, t K×ACROSS px, module K px, half-length K px, cells K×n."""

    s: np.ndarray
    t: np.ndarray
    module: np.ndarray
    half_px: np.ndarray
    cells: np.ndarray

    def select(self, borders: np.ndarray) -> "_BorderModel":
        """The model of some of the borders."""
        return _BorderModel(self.s, self.t[borders], self.module[borders], self.half_px[borders], self.cells[borders])

    def shares(self, theta):
        """The share of paper in the light, and its derivatives by u and by log σ, each K×ALONG×ACROSS."""
        d, a, log_sigma = (theta[:, i, None, None] for i in range(3))
        sigma = np.exp(log_sigma)
        u = self.t[:, None, :] - d - a * self.s[:, None]
        outer, inner = u / sigma, -(u + self.module[:, None, None]) / sigma
        row = self._blurred_row(sigma[:, 0])[..., None]
        bell_out, bell_in = _bell(outer), row * _bell(inner)
        return ndtr(outer) + row * ndtr(inner), (bell_out - bell_in) / sigma, -bell_out * outer - bell_in * inner

    def _blurred_row(self, sigma):
        """q: the blurred row of cells behind the rim, K×ALONG."""
        n = self.cells.shape[1]
        modules = (self.s + 1) / 2 * n  # from the border's start
        z = (modules[None, :, None] - np.arange(n + 1)) * (2 * self.half_px / n / sigma[:, 0])[:, None, None]
        steps = ndtr(z)
        return ((steps[..., :-1] - steps[..., 1:]) * self.cells[:, None, :]).sum(-1)


def _bell(z):
    return np.exp(-z * z / 2) / np.sqrt(2 * np.pi)


def _fit_parameters(light, model, converged_px):
    """Parameters K×5 (d, a, σ, black, white) of K borders from K×ALONG×ACROSS samples."""
    range_px = model.t[:, -1]
    black, white = light[:, :, 4:9].min(2).mean(1), light[:, :, -4:].mean((1, 2))
    theta = np.stack([0 * range_px, 0 * range_px, np.log(np.maximum(0.25 * range_px, 0.5)), black, white], 1)
    weight, prediction = np.ones(light.shape[:2]), _predict_light(theta, model)
    for round_, max_steps in enumerate(_MAX_STEPS):
        theta = _gauss_newton(theta, prediction, light, model, weight, range_px, max_steps, converged_px)
        if round_ == 0:  # stretches that fit far worse than the border's typical one show something else
            prediction = _predict_light(theta, model)
            misfit = np.sqrt(((prediction[0] - light) ** 2).mean(2))
            floor = 0.03 * np.abs(theta[:, 4] - theta[:, 3])
            weight = (misfit < 3 * np.maximum(np.median(misfit, 1), floor)[:, None]).astype(float)
    theta[:, 2] = np.exp(theta[:, 2])
    return theta


def _predict_light(theta, model):
    black, white = theta[:, 3, None, None], theta[:, 4, None, None]
    shares = model.shares(theta)
    return black + (white - black) * shares[0], *shares


def _gauss_newton(theta, prediction, light, model, weight, range_px, max_steps, converged_px):
    """Damped Gauss-Newton of all borders at once, from `theta` and its `prediction`, each to within `converged_px`."""
    fitted, active = theta.copy(), np.arange(len(theta))
    damping, root = np.full(len(theta), 1e-3), np.sqrt(weight)[..., None]
    cost = (((light - prediction[0]) * root) ** 2).sum((1, 2))
    for _ in range(max_steps):
        jacobian, residual = _normal_rows(prediction, light, theta, model, root)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        gradient = (jacobian.transpose(0, 2, 1) @ residual[..., None])[..., 0]
        scale = np.einsum("kpp->kp", normal) + 1e-9
        damped = normal + (damping[:, None] * scale)[..., None] * np.eye(5)
        trial = theta + np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial[:, 0] = np.clip(trial[:, 0], -range_px, range_px)
        trial[:, 2] = np.clip(trial[:, 2], np.log(0.25), np.log(2 * range_px))
        trial_prediction = _predict_light(trial, model)
        trial_cost = (((light - trial_prediction[0]) * root) ** 2).sum((1, 2))
        better = trial_cost <= cost
        step_px = np.abs(trial - theta)[:, :2].max(1)
        theta, cost = np.where(better[:, None], trial, theta), np.where(better, trial_cost, cost)
        fitted[active] = theta
        on = ~(step_px < converged_px)  # places without a border never converge, and the others need not wait for them
        if not on.any():
            break
        pairs = zip(trial_prediction, prediction, strict=True)
        prediction = tuple(np.where(better[on, None, None], a[on], b[on]) for a, b in pairs)
        damping = np.clip(np.where(better, damping / 5, damping * 10), 1e-7, 1e6)[on]
        active, theta, cost, model = active[on], theta[on], cost[on], model.select(on)
        light, root, range_px = light[on], root[on], range_px[on]
    return fitted


def _normal_rows(prediction, light, theta, model, root):
    """The weighted Jacobian K×N×5 of the light by the parameters, and the weighted residual K×N."""
    value, share, by_u, by_log_sigma = prediction
    span = (theta[:, 4] - theta[:, 3])[:, None, None] * root
    by_d = -by_u * span
    columns = [by_d, by_d * model.s[:, None], by_log_sigma * span, (1 - share) * root, share * root]
    count = len(theta)
    return np.stack(columns, -1).reshape(count, -1, 5), ((light - value) * root).reshape(count, -1)
