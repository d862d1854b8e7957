"""A whole rail vehicle on a 3-D track, written without a look at the package's equations.

It serves benchmarks/named_parts.py: recordings whose every spring and damper is known. The
car body, two bogie frames and four wheelsets are rigid bodies that sway, bounce, roll, pitch and
yaw; the body bends; the wheelsets stand on elastic contacts and creep (Kalker, linear). It is
linear, so that its response to a track of random phases is exact in each bin of a Fourier transform
that is longer than the trip. x is forward, y to the left, z up; a rotation r moves a point p by
r x p. Sources: textbooks (Wickens; Knothe and Stichel), and the German track spectra.
"""

from dataclasses import dataclass, field, fields, replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.fft
import yaml

# places of sensors: channel, axle (0: the frame's centre, or the body), side
PAIRS = tuple((c, a, s) for c, a in (("axle_box", 1), ("bogie", 1), ("body", 0)) for s in (1, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # axle 1 left, right, axle 2 left, right
SIDES = (1, -1)
COMPONENTS = (
    *(f"{n}_axle{a}_{s}" for a in (1, 2) for s in ("left", "right") for n in ("k_p", "c_p")),
    *(f"{n}_{s}" for s in ("left", "right") for n in ("k_s", "c_s")),
    "M_s",
)
SENSOR_Y_M = 1.0
RATE_HZ = 200.0
HIGHEST_HZ = 90.0  # of the track: nothing is folded at 200 Hz
SNR_DB = 34.0
SMALL = 1e-9


@dataclass(frozen=True)
class Train:
    """Numbers of a vehicle in SI units; those of a kind are arrays, corners or sides of a bogie."""

    body_kg: float = 25200.0
    body_gyration_m: tuple = (1.3, 7.8, 7.8)  # roll, pitch, yaw
    frame_kg: float = 3450.0
    frame_gyration_m: tuple = (0.75, 0.8, 1.05)
    wheelset_kg: float = 1500.0
    wheelset_gyration_m: float = 0.73
    half_wheelbase_m: float = 1.35
    half_pivot_m: float = 9.5
    primary_y_m: float = 1.0
    secondary_y_m: float = 1.0
    yaw_damper_y_m: float = 1.3
    primary_z_m: float = -0.1  # of the springs' middle, from the frame's centre of mass
    secondary_z_m: float = 0.3  # likewise
    body_z_m: float = -0.8  # of the secondary springs' middle, from the body's centre of mass
    primary_k: np.ndarray = field(default_factory=lambda: np.full((2, 4), 0.65e6))
    primary_c: np.ndarray = field(default_factory=lambda: np.full((2, 4), 1.85e3))
    primary_kx: float = 15e6
    primary_ky: float = 5e6
    primary_bushing: float = 5e6
    secondary_k: np.ndarray = field(default_factory=lambda: np.full((2, 2), 0.69e6))
    secondary_c: np.ndarray = field(default_factory=lambda: np.full((2, 2), 22.6e3))
    secondary_kxy: float = 0.16e6
    secondary_bushing: float = 5e6
    secondary_damper_y_m: float = 0.0  # outside of the springs
    lateral_c: float = 30e3
    yaw_damper_c: float = 200e3
    yaw_damper_bushing: float = 6e6
    antiroll: float = 0.9e6
    bending_hz: float = 9.0
    bending_damping: float = 0.02
    body_length_m: float = 25.0
    torsion_hz: float = 0.0  # none
    torsion_damping: float = 0.02
    torsion_share: float = 0.25  # of the frame's mass, where a corner moves by 1
    contact_k: float = 1.0e9
    creep_x: float = 6e6
    creep_y: float = 5e6
    conicity: float = 0.1
    half_gauge_m: float = 0.75
    wheel_radius_m: float = 0.43
    gravity_k: float = 2e4
    cone_lift: float = 0.0  # 1: a wheelset that moves sideways also rolls on its cones
    sensitivity: np.ndarray = field(default_factory=lambda: np.ones(6))
    delay_s: np.ndarray = field(default_factory=lambda: np.zeros(6))
    yaw_damper_z_m: float = 0.0  # above the secondary springs
    places: tuple = PAIRS  # of sensors; the side 0 is the middle

    @classmethod
    def scattered(cls, seed, geometry=0.1, unequal=0.05, sensors=False, torsion=False, scatter=0.1):
        """Return a train with numbers of its own; `geometry` scatters wheelbase and pivots."""
        rng = np.random.default_rng([seed, 1])
        parts = np.random.default_rng([seed, 2])
        errors = np.random.default_rng([seed, 3])
        drawn = {}
        for one in fields(cls):
            if one.name == "places":
                continue
            value = getattr(cls(), one.name)
            wide = 3 * scatter if "bushing" in one.name else scatter
            n = np.size(value) if isinstance(value, tuple) else 1
            z = np.clip(rng.standard_normal(n), -1.5, 1.5)
            if one.name in ("half_wheelbase_m", "half_pivot_m"):
                wide = min(geometry, scatter)
            if one.name in ("sensitivity", "delay_s"):
                continue
            new = np.exp(wide * z) * np.asarray(value)
            if isinstance(value, tuple):
                drawn[one.name] = tuple(float(v) for v in new)
            elif isinstance(value, np.ndarray):
                drawn[one.name] = new * (1 + unequal * parts.standard_normal(value.shape))
            else:
                drawn[one.name] = float(new[0])
        drawn["wheel_radius_m"], drawn["half_gauge_m"] = 0.43, 0.75
        if torsion:
            drawn["torsion_hz"] = 35.0 * np.exp(0.05 * errors.standard_normal())
        if sensors:
            drawn["sensitivity"] = 1 + 0.02 * errors.standard_normal(6)
            drawn["delay_s"] = 0.5e-3 * errors.standard_normal(6)
        return cls(**drawn)

    def measured_at(self, places, seed=None):
        """Return the vehicle with sensors at other places, ideal ones without a seed."""
        size = 0.0 if seed is None else 1.0
        drawn = size * np.random.default_rng([seed or 0, 4]).standard_normal((2, len(places)))
        own = {"sensitivity": 1 + 0.02 * drawn[0], "delay_s": 0.5e-3 * drawn[1]}
        return replace(self, places=tuple(places), **own)

    def worn(self, ratios):
        """Return the vehicle with the 13 ratios of its leading bogie and its body."""
        ratios = np.asarray(ratios, float)
        change = {}
        for name, first, every in (("primary_k", 0, 4), ("primary_c", 1, 4)):
            value = np.array(getattr(self, name))
            value[0] *= ratios[first : 2 * every : 2]
            change[name] = value
        for name, first in (("secondary_k", 8), ("secondary_c", 9)):
            value = np.array(getattr(self, name))
            value[0] *= ratios[first:12:2]
            change[name] = value
        # the bending's stiffness stays, its mass grows with the load
        change["bending_hz"] = self.bending_hz / np.sqrt(ratios[12])
        return replace(self, body_kg=self.body_kg * ratios[12], **change)

    def turned(self):
        """Return the vehicle turned by 180 degrees: its leading left is its trailing right."""
        change = {n: getattr(self, n)[::-1, ::-1] for n in ("primary_k", "primary_c")}
        change |= {n: getattr(self, n)[::-1, ::-1] for n in ("secondary_k", "secondary_c")}
        return replace(self, **change)


def bending_shape(x_m, length_m):
    """Return the first bending mode of a free beam and its slope [1/m], 1 in the rms."""
    beta = 4.730040744862704 / length_m
    ratio = np.cos(beta * length_m / 2) / np.cosh(beta * length_m / 2)
    scale = np.sqrt(2 / (1 + ratio**2))
    x = beta * np.asarray(x_m, float)
    shape = np.cos(x) + ratio * np.cosh(x)
    slope = beta * (-np.sin(x) + ratio * np.sinh(x))
    return scale * shape, scale * slope


class Motion:
    """The equations of motion M a + C v + K q = G u, and its dampers behind bushings.

    Coordinates: body y, z, roll, pitch, yaw, bending; of each frame y, z, roll, pitch, yaw,
    torsion; of each wheelset y, z, roll, yaw. Inputs u: of each wheelset the mean height of the
    rails, half their difference, and their alignment [m].
    """

    n_coordinates = 6 + 2 * 6 + 4 * 4

    def __init__(self, train, speed_m_per_s):
        self.train, self.speed = train, speed_m_per_s
        n = self.n_coordinates
        self.mass, self.damping, self.stiffness = (np.zeros((n, n)) for _ in range(3))
        self.forcing = np.zeros((n, 12))
        self.rows, self.series_k, self.series_c = [], [], []
        self.masses()
        for bogie in range(2):
            self.primary(bogie)
            self.secondary(bogie)
        for axle in range(4):
            self.contact(axle)
        self.state_space()

    # kinematics
    def body(self, x, y, z):
        at = np.zeros((3, self.n_coordinates))
        shape, slope = bending_shape(x, self.train.body_length_m)
        at[:, :6] = [[0, 0, 0, z, -y, -z * slope], [1, 0, -z, 0, x, 0], [0, 1, y, -x, 0, shape]]
        return at

    def frame(self, bogie, x, y, z):
        at = np.zeros((3, self.n_coordinates))
        corner = self.train.half_wheelbase_m * self.train.primary_y_m
        warp = x * y / corner if self.train.torsion_hz else 0.0
        at[:, 6 + 6 * bogie : 12 + 6 * bogie] = [
            [0, 0, 0, z, -y, 0],
            [1, 0, -z, 0, x, 0],
            [0, 1, y, -x, 0, warp],
        ]
        return at

    def wheelset(self, axle, y, z):
        at = np.zeros((3, self.n_coordinates))
        at[:, 18 + 4 * axle : 22 + 4 * axle] = [[0, 0, 0, -y], [1, 0, -z, 0], [0, 1, y, 0]]
        return at

    def axle_x(self):
        """Return the place of each wheelset ahead of the vehicle's middle [m]."""
        a, p = self.train.half_wheelbase_m, self.train.half_pivot_m
        return np.array([p + a, p - a, -p + a, -p - a])

    # elements
    def spring(self, row, k):
        self.stiffness += k * np.outer(row, row)

    def damper(self, row, c, series_k):
        self.rows.append(row)
        self.series_c.append(c)
        self.series_k.append(series_k)

    def masses(self):
        t = self.train
        diagonal = np.zeros(self.n_coordinates)
        diagonal[:2] = diagonal[5] = t.body_kg
        diagonal[2:5] = t.body_kg * np.square(t.body_gyration_m)
        omega = 2 * np.pi * t.bending_hz
        self.stiffness[5, 5] = t.body_kg * omega**2
        self.damping[5, 5] = 2 * t.bending_damping * omega * t.body_kg
        for bogie in range(2):
            first = 6 + 6 * bogie
            diagonal[first : first + 2] = t.frame_kg
            diagonal[first + 2 : first + 5] = t.frame_kg * np.square(t.frame_gyration_m)
            diagonal[first + 5] = warp = t.torsion_share * t.frame_kg
            # without torsion, its coordinate moves nothing
            omega = 2 * np.pi * (t.torsion_hz or 35.0)
            self.stiffness[first + 5, first + 5] = warp * omega**2
            self.damping[first + 5, first + 5] = 2 * t.torsion_damping * omega * warp
        for axle in range(4):
            first = 18 + 4 * axle
            diagonal[first : first + 2] = t.wheelset_kg
            diagonal[first + 2 : first + 4] = t.wheelset_kg * t.wheelset_gyration_m**2
        self.mass = np.diag(diagonal)

    def primary(self, bogie):
        t = self.train
        for corner, (ahead, left) in enumerate(CORNERS):
            axle = 2 * bogie + (0 if ahead > 0 else 1)
            y = left * t.primary_y_m
            over = self.frame(bogie, ahead * t.half_wheelbase_m, y, t.primary_z_m)
            e = over - self.wheelset(axle, y, 0.0)
            for row, k in zip(e, (t.primary_kx, t.primary_ky, None), strict=True):
                self.spring(row, t.primary_k[bogie, corner] if k is None else k)
            self.damper(e[2], t.primary_c[bogie, corner], t.primary_bushing)

    def secondary(self, bogie):
        t = self.train
        x = t.half_pivot_m * (1 - 2 * bogie)

        def elongation(y, z=0.0):
            body = self.body(x, y, t.body_z_m + z)
            return body - self.frame(bogie, 0.0, y, t.secondary_z_m + z)

        for side, left in enumerate(SIDES):
            e = elongation(left * t.secondary_y_m)
            for row, k in zip(e, (t.secondary_kxy, t.secondary_kxy, None), strict=True):
                self.spring(row, t.secondary_k[bogie, side] if k is None else k)
            outside = elongation(left * (t.secondary_y_m + t.secondary_damper_y_m))
            self.damper(outside[2], t.secondary_c[bogie, side], t.secondary_bushing)
            far = elongation(left * t.yaw_damper_y_m, t.yaw_damper_z_m)
            self.damper(far[0], t.yaw_damper_c, t.yaw_damper_bushing)
        middle = elongation(0.0)[1]
        self.damping += t.lateral_c * np.outer(middle, middle)
        roll = np.zeros(self.n_coordinates)
        roll[2], roll[6 + 6 * bogie + 2] = 1, -1
        self.spring(roll, t.antiroll)

    def contact(self, axle):
        t, v = self.train, self.speed
        b, r, first = t.half_gauge_m, t.wheel_radius_m, 18 + 4 * axle
        mean, half, aside = np.eye(12)[3 * axle : 3 * axle + 3]
        for left in SIDES:
            row = self.wheelset(axle, left * b, -r)[2]
            row[first] -= t.cone_lift * left * t.conicity
            of = mean + left * half - t.cone_lift * left * t.conicity * aside
            self.spring(row, t.contact_k)
            self.forcing += t.contact_k * np.outer(row, of)
        # creep: sideways, at the contact; forward, as a moment of yaw
        slip = self.wheelset(axle, 0.0, -r)[1]
        self.damping += 2 * t.creep_y / abs(v) * np.outer(slip, slip)
        yaw = np.zeros(self.n_coordinates)
        yaw[first + 3] = 1
        self.stiffness -= 2 * t.creep_y * np.sign(v) * np.outer(slip, yaw)
        self.damping += 2 * t.creep_x * b**2 / abs(v) * np.outer(yaw, yaw)
        cone = 2 * t.creep_x * b * t.conicity / r * np.sign(v)
        y = np.zeros(self.n_coordinates)
        y[first] = 1
        self.stiffness += cone * np.outer(yaw, y) + t.gravity_k * np.outer(y, y)
        self.forcing += np.outer(cone * yaw + t.gravity_k * y, aside)

    def state_space(self):
        """Set a, b of s' = a s + b u with s = (q, v, elongation of each damper), and sensors."""
        n, rows = self.n_coordinates, np.array(self.rows)
        m, k, c = len(rows), np.array(self.series_k), np.array(self.series_c)
        inverse = np.linalg.inv(self.mass)
        stiff = self.stiffness + rows.T @ (k[:, None] * rows)
        self.a = np.zeros((2 * n + m, 2 * n + m))
        self.a[:n, n : 2 * n] = np.eye(n)
        self.a[n : 2 * n, :n] = -inverse @ stiff
        self.a[n : 2 * n, n : 2 * n] = -inverse @ self.damping
        self.a[n : 2 * n, 2 * n :] = inverse @ (rows.T * k)
        self.a[2 * n :, :n] = (k / c)[:, None] * rows
        self.a[2 * n :, 2 * n :] = -np.diag(k / c)
        self.b = np.zeros((2 * n + m, 12))
        self.b[n : 2 * n] = inverse @ self.forcing
        points = self.sensors()
        self.c = points @ self.a[n : 2 * n]
        self.d = points @ self.b[n : 2 * n]

    def sensors(self):
        """Return the height of each sensor, (n_sensors, n_coordinates)."""
        t, at = self.train, []
        ahead = {1: t.half_wheelbase_m, 2: -t.half_wheelbase_m, 0: 0.0}
        for channel, axle, left in t.places:
            y = left * SENSOR_Y_M
            if channel == "axle_box":
                at.append(self.wheelset(axle - 1, y, 0.0)[2])
            elif channel == "bogie":
                at.append(self.frame(0, ahead[axle], y, 0.0)[2])
            else:
                at.append(self.body(t.half_pivot_m, y, 0.0)[2])
        return np.array(at)

    def poles(self):
        """Return the poles [rad/s]; ValueError if the vehicle hunts."""
        poles = np.linalg.eigvals(self.a)
        if poles.real.max() > -SMALL:
            raise ValueError(f"the vehicle is unstable at {self.speed} m/s")
        return poles

    def delays(self):
        """Return the time at which each wheelset meets the track after the first one [s]."""
        ahead = np.sign(self.speed) * self.axle_x()
        return (ahead.max() - ahead) / abs(self.speed)

    def response(self, inputs, frequencies_hz):
        """Return the accelerations (n_sensors, n_freq) to the inputs' spectra (12, n_freq)."""
        poles, modes = np.linalg.eig(self.a)
        if poles.real.max() > -SMALL:
            raise ValueError(f"the vehicle is unstable at {self.speed} m/s")
        into, out = np.linalg.solve(modes, self.b.astype(complex)), self.c @ modes
        found = np.empty((len(self.c), inputs.shape[1]), complex)
        for start in range(0, inputs.shape[1], 8192):
            part = slice(start, start + 8192)
            s = 2j * np.pi * frequencies_hz[part]
            q = (into @ inputs[:, part]) / (s - poles[:, None])
            found[:, part] = out @ q + self.d @ inputs[:, part]
        return found


@dataclass(frozen=True)
class Track:
    """Spectral densities of a line, German spectra of low disturbance; densities are one-sided."""

    strength: float = 4.032e-7
    cross_share: float = 1 / 3
    alignment_share: float = 1 / 3
    corner: float = 0.8246
    alignment_corner: float = 0.8246

    @classmethod
    def drawn(cls, rng):
        cross, aside = 1 / rng.uniform(2, 4, 2)
        scale = np.exp(0.2 * rng.standard_normal(3))
        return cls(4.032e-7 * scale[0], cross, aside, 0.8246 * scale[1], 0.8246 * scale[2])

    def densities(self, frequencies_hz, speed_m_per_s):
        """Return (3, n_freq), of mean, half the cross level and alignment [m^2/Hz]."""
        omega2 = np.square(2 * np.pi * frequencies_hz / abs(speed_m_per_s))

        def german(corner):
            return self.strength * corner**2 / ((omega2 + 0.0206**2) * (omega2 + corner**2))

        cross = omega2 / (omega2 + 0.438**2) * self.cross_share * german(self.corner)
        every = [german(self.corner), cross, self.alignment_share * german(self.alignment_corner)]
        return 2 * np.pi / abs(speed_m_per_s) * np.array(every)


@dataclass(frozen=True)
class Run:
    """How a trip was made."""

    speed_m_per_s: float = 70.0
    direction: str = "forward"
    minutes: float = 20.0
    alone_share: float = 0.0  # of the track's power that excites each wheelset alone
    noise: bool = True
    rate_hz: float = RATE_HZ


def spectrum(density, n_samples, rate_hz, rng):
    """Return the Fourier transform of noise with one-sided densities (..., n_freq) per Hz."""
    drawn = rng.standard_normal((*density.shape, 2)) @ [1, 1j]
    return np.sqrt(density * rate_hz * n_samples) / 2 * drawn


def track_inputs(motion, track, run, n_samples, rng):
    """Return the 12 inputs' Fourier transforms (12, n_freq) and their frequencies."""
    frequencies = np.arange(n_samples // 2 + 1) * run.rate_hz / n_samples
    kept = (frequencies > 0) & (frequencies <= HIGHEST_HZ)
    density = np.zeros((3, len(frequencies)))
    density[:, kept] = track.densities(frequencies[kept], motion.speed)
    common = spectrum(density, n_samples, run.rate_hz, rng)
    later = np.exp(-2j * np.pi * frequencies * motion.delays()[:, None])
    inputs = later[:, None] * common
    if run.alone_share:
        alone = np.broadcast_to(run.alone_share * density, (4, *density.shape))
        inputs = inputs + spectrum(alone, n_samples, run.rate_hz, rng)
    return inputs.reshape(12, -1), frequencies


def record(train, track, run, seed):
    """Return the sensors' accelerations of a trip, (n_sensors, n_samples) [m/s^2]."""
    rng = np.random.default_rng(seed)
    speed = run.speed_m_per_s if run.direction == "forward" else -run.speed_m_per_s
    motion = Motion(train, speed)
    n_samples = round(60 * run.minutes * run.rate_hz)
    longer = scipy.fft.next_fast_len(n_samples + round(60 * run.rate_hz), real=True)
    inputs, frequencies = track_inputs(motion, track, run, longer, rng)
    motions = motion.response(inputs, frequencies)
    motions *= np.exp(-2j * np.pi * frequencies * train.delay_s[:, None])
    signals = train.sensitivity[:, None] * np.fft.irfft(motions, longer)[:, :n_samples]
    if run.noise:
        rms = 10 ** (-SNR_DB / 20) * signals.std(axis=1, keepdims=True)
        signals += rms * rng.standard_normal(signals.shape)
    return signals


def write_trip(folder, name, signals, run, mileage_km=1000.0, places=PAIRS):
    """Write a trip as a Parquet file and its manifest, and return the manifest's path."""
    columns = [f"sensor_{i}" for i in range(len(places))]
    table = pa.table(dict(zip(columns, signals.astype(np.float32), strict=True)))
    pq.write_table(table, folder / f"{name}.parquet", compression="none")
    channels = {}
    for column, (channel, axle, left) in zip(columns, places, strict=True):
        source = {"file": f"{name}.parquet", "unit": "m/s2", "rate_hz": run.rate_hz}
        source |= {"column": column, "side": SIDE_NAMES[left]}
        source |= {"axle": 2} if axle == 2 else {}
        channels.setdefault(channel, []).append(source)
    manifest = {
        "format": "suspnet-trip-1",
        "vehicle": "am96",
        "suspension": "blind",
        "bogie": "leading",
        "direction": run.direction,
        "mileage_km": mileage_km,
        "speed": float(run.speed_m_per_s),
        "channels": channels,
    }
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(manifest, sort_keys=False))
    return path


SIDE_NAMES = {1: "left", -1: "right", 0: "middle"}
