"""What a rough train has beyond the family, each effect against an independent evaluation."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from reference import phasors
from rich_effects import FAMILY, FLEXIBLE, LAWS, ROUGH
from rich_line import of_the_trip, rough_profiles
from rich_modes import simulate_modes, tones
from rich_motion import CHOKE_M_PER_S, march, simulate
from rich_sensors import MAINS, NOISE, RANGES_G, recorded
from rich_spectra import responses_of
from rich_train import RichTrain
from rich_train_trips import Drive, write_train_trips
from rich_vehicle import RichSystem
from scipy.constants import g
from scipy.integrate import solve_ivp
from scipy.signal import welch
from trips_reference import pitching_matrices, pitching_numbers
from vehicles import AM96

from suspnet.trains.simulation import Fleet
from suspnet.vehicle.track import TrackProfile, make_profile, track_spectrum

WORN = np.array([0.8, 1.3, 1.2, 0.7, 1.1])
HEALTHY = np.ones(5)
BINS = np.arange(0.5, 20.0, 0.5)
S = 2j * math.pi * BINS
LINEAR = (*FAMILY, *FLEXIBLE, "ballast", "cross_axis")
SENSOR = {name: {"rate_hz": 250.0} for name in ("axle_box", "bogie", "body")}


def held(mass, hz, damping):
    """Return the dynamic stiffness of a spring and damper that hold a mass at a frequency."""
    omega = 2 * math.pi * hz
    return mass * omega**2 + 2 * damping * mass * omega * S


def half_vehicle(dynamic_mass, ratios):
    """Return box, frame and body of the plain half vehicle with another mass matrix."""
    n = pitching_numbers(AM96, ratios, 70.0)
    mass, damping, stiffness, input_damping, input_stiffness = pitching_matrices(n)
    found = []
    for i, (s, wheels) in enumerate(zip(S, RichTrain().phasors(BINS)[:, :, 0], strict=True)):
        whole = dynamic_mass(mass.astype(complex), n, i) * s**2 + damping * s + stiffness
        q = np.linalg.solve(whole, (input_damping * s + input_stiffness) @ wheels)
        found.append([1.0, q[2] + n["a"] * q[3], q[0] + n["L"] * q[1]])
    return np.array(found)


# reference: structure


def test_equipment_is_a_mass_that_depends_on_frequency():
    numbers = {"equipment_x_m": 0.0, "equipment_y_m": 0.0}
    train = RichTrain(frozenset({"equipment"}), **numbers)
    kg = train.equipment_kg
    spring = held(kg, train.equipment_hz, train.equipment_damping)
    apparent = kg * spring / (spring + kg * S**2)

    def hung(mass, n, i):
        mass[0, 0] += (apparent[i] - kg) / 2  # of half the body
        return mass

    expected = half_vehicle(hung, WORN)
    assert np.abs(expected / half_vehicle(lambda m, *_: m, WORN) - 1).max() > 0.1
    found = responses_of(train, WORN, BINS, "mean")[..., 0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_floors_are_small_oscillators_under_the_sensors():
    train = RichTrain.scattered(2, {"floors", "roll"})
    light = replace(train, floors_kg=1e-6)
    plain = RichTrain(frozenset({"roll"}), **train.numbers())
    found, expected = (responses_of(one, WORN, BINS) for one in (light, plain))
    for sensor, hz in ((4, train.floors_hz), (5, train.floors_right_hz)):
        spring = held(1.0, hz, train.floors_damping)
        ratio = found[:, sensor] / expected[:, sensor]
        np.testing.assert_allclose(
            ratio, (spring / (spring + S**2))[:, None].repeat(3, 1), rtol=1e-5
        )
    np.testing.assert_allclose(found[:, :4], expected[:, :4], rtol=1e-5)


def test_axle_box_moves_as_a_wheelset_on_contact_and_ballast():
    free = {"k_p": 1e-9, "c_p": 1e-9, "guidance_n_per_m": 0.0, "guidance_ns_per_m": 0.0}
    free |= {"primary_lateral_n_per_m": 1.0, "creep_n": 1e-3, "gravity_n_per_m": 0.0}
    train = RichTrain(frozenset({"ballast", "roll"}), **free)
    contact = 2 * (train.contact_n_per_m + train.contact_ns_per_m * S)
    track = train.ballast_n_per_m + train.ballast_ns_per_m * S + train.track_kg * S**2
    receptance = 1 / contact + 1 / track
    expected = 1 / (1 + train.wheelset_kg * S**2 * receptance)
    assert abs(expected[BINS == 10.0][0] - 1) > 0.05
    found = responses_of(train, HEALTHY, BINS)
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-7)
    # rolling, at the lever arm of the rails; sensors and rails are apart
    inertia = train.wheelset_kg * (train.wheelset_gyration_m / train.contact_half_m) ** 2
    expected = train.sensor_half_m / train.contact_half_m / (1 + inertia * S**2 * receptance)
    np.testing.assert_allclose(found[:, 0, 1], expected, rtol=1e-6)


def test_wheels_that_nothing_holds_do_not_slip_on_a_track_that_turns():
    """Creep acts at the rails, a wheel's radius below the axle, which moves aside by that."""
    free = {"guidance_n_per_m": 1e-3, "guidance_ns_per_m": 0.0, "primary_lateral_n_per_m": 1e-3}
    train = RichTrain(frozenset({"roll", "cross_axis"}), conicity=0.0, creep_n=1e13, **free)
    found = [
        responses_of(replace(train, cross_axis_0=share), HEALTHY, BINS)[:, 0, 1]
        for share in (0.0, 1.0)
    ]
    expected = -train.wheel_radius_m / train.contact_half_m
    np.testing.assert_allclose(found[1] - found[0], expected, rtol=1e-4)


@pytest.mark.parametrize("effect", ["torsion", "frame_torsion"])
def test_torsions_have_their_frequency_where_nothing_else_holds_them(effect):
    free = {"k_p": 1e-6, "k_s": 1e-6, "c_p": 1e-6, "c_s": 1e-6, "anti_roll_nm": 0.0}
    free |= {"lateral_n_per_m": 0.0, "lateral_ns_per_m": 0.0, "primary_lateral_n_per_m": 0.0}
    train = RichTrain.scattered(4, {effect}, **free)
    a, _, _ = train.matrices(HEALTHY).state_space()
    roots = np.linalg.eigvals(a)
    hz, damping = (getattr(train, f"{effect}_{kind}") for kind in ("hz", "damping"))
    root = roots[np.argmin(np.abs(roots - 2j * math.pi * hz))]
    assert abs(root) / (2 * math.pi) == pytest.approx(hz, rel=2e-3)
    assert -root.real / abs(root) == pytest.approx(damping, rel=0.05)


def test_sensors_read_a_share_of_the_lateral_motion_of_their_place():
    train = RichTrain.scattered(5, (*FAMILY, "cross_axis"))
    shares = np.array([getattr(train, f"cross_axis_{i}") for i in range(6)])
    assert np.abs(shares).min() > 1e-3
    plain = replace(train, **{f"cross_axis_{i}": 0.0 for i in range(6)})
    found, expected = (responses_of(one, WORN, BINS) for one in (train, plain))
    names, matrices = train._structure.names, train.matrices(WORN)

    def moved(body, freedom):
        row = np.eye(1, matrices.sensors.shape[1], names.index((body, freedom)))
        return matrices.responses(BINS, train.phasors(BINS), row)[:, 0]

    frame = moved("bogie 1", "y") + train.half_wheelbase_m * moved("bogie 1", "yaw")
    body = moved("body", "y") + train.half_pivot_m * moved("body", "yaw")
    body = body + train.floor_below_m * moved("body", "roll")
    aside = np.stack([moved("wheelset 0", "y")] * 2 + [frame] * 2 + [body] * 2, axis=1)
    np.testing.assert_allclose(found, expected + shares[:, None] * aside, rtol=1e-9)


# reference: motion


def test_rough_linear_train_moves_in_time_as_its_spectra_say():
    train, f = RichTrain.scattered(3, LINEAR), [0.9, 2.3, 5.1, 8.0, 14.0]
    rate_hz, n = 500.0, 2000
    signals = simulate_modes(train.matrices(WORN), tones(train, f, 0.01), rate_hz, n, 30_000)
    found = phasors(signals, np.arange(n) / rate_hz, f)
    expected = responses_of(train, WORN, f) @ np.exp(1j * np.arange(3))
    expected *= -2 * math.pi * np.array(f)[:, None] * 0.01
    assert np.abs(found / expected - 1).max() < 5e-4


def test_laws_that_do_not_act_leave_the_linear_train():
    effects = {*LINEAR, "rebound", "secondary_friction"}
    off = {"rebound_share": 1e-12, "secondary_friction_n": 1e-9}
    train = RichTrain.scattered(3, effects, **off)
    track = tones(train, [0.9, 5.1, 9.0], 0.01)
    found = simulate([WORN], train, [track], 500.0, 500, 10_000)[0]
    linear = simulate_modes(train.matrices(WORN), track, 500.0, 500, 10_000)
    error = np.abs(found - linear).max(axis=1) / np.abs(linear).max(axis=1)
    assert error.max() < 1e-3  # the two start differently, 20 s before


def damper(**changes):
    """Return a damper and a bushing in series between two points, with its k and c."""
    k, c = 0.7e6, 22.6e3
    numbers = {"blow_off_n": math.inf, "rebound": 0.0, "exponent": 1.0, "damping": c} | changes
    own = {name: np.array([value]) for name, value in numbers.items()}
    own |= {"a": np.array([[-k / c]]), "b_v": np.array([[k]]), "e": np.array([[-k]])}
    own |= {name: np.zeros((1, 1)) for name in ("b_r", "s", "s_w")} | {"lift": np.zeros((2, 1))}
    own |= {name: np.zeros((0, 1)) for name in ("rubber_x", "rubber_r")}
    system = RichSystem(**own, friction_n=np.zeros(0), friction_half_m=np.zeros(0))
    return SimpleNamespace(build=lambda _: system, slope_after=0.2), k, c


def velocity_of(force, c, blow_off_n, rebound, exponent):
    """Return the velocity of a damper at a force, the inverse of its law."""
    size, sign = abs(force), math.copysign(1, force)
    whole = size if size <= blow_off_n else blow_off_n + (size - blow_off_n) / 0.2
    strength = c * (1 + sign * rebound)
    return sign * CHOKE_M_PER_S * (whole / (strength * CHOKE_M_PER_S)) ** (1 / exponent)


@pytest.mark.parametrize(
    "laws", [{"exponent": 1.8}, {"rebound": 0.2}, {"rebound": 0.2, "blow_off_n": 1500.0}]
)
def test_damper_follows_its_law_and_balances_its_energy(laws):
    rich, k, c = damper(**laws)
    hz, speed, rate_hz = 1.25, 0.12, 1000.0
    omega = 2 * math.pi * hz

    def track(times):
        waves = [
            np.sin(omega * times) / omega,
            np.cos(omega * times),
            -omega * np.sin(omega * times),
        ]
        return speed * np.array(waves)[:, None]

    (found,) = (x for _, x, _ in march([None], rich, [track], rate_hz, 1601))
    force = found[0, 0]
    full = {"blow_off_n": math.inf, "rebound": 0.0, "exponent": 1.0} | laws
    times = np.arange(1601) / rate_hz
    solved = solve_ivp(
        lambda t, f: [k * (speed * math.cos(omega * t) - velocity_of(f[0], c, **full))],
        (0, times[-1]),
        [0.0],
        t_eval=times,
        rtol=1e-8,
        atol=1e-4,
        method="LSODA",
    )
    size = np.abs(solved.y[0]).max()
    linear = speed * c / math.hypot(1, omega * c / k)
    assert abs(size / linear - 1) > 0.05
    np.testing.assert_allclose(force, solved.y[0], rtol=0, atol=3e-3 * size)
    # over the last period the bushing gives back what it took: the damper dissipates all
    last = slice(800, 1601)
    velocity = [velocity_of(f, c, **full) for f in force[last]]
    taken = np.trapezoid(force[last] * speed * np.cos(omega * times[last]), times[last])
    lost = np.trapezoid(force[last] * velocity, times[last])
    assert taken == pytest.approx(lost, rel=5e-3)
    if laws.get("rebound"):
        assert force[last].max() > -1.1 * force[last].min()


# reference: line


def drive(train, minutes=0.2, speed_m_per_s=70.0, **changes):
    fleet = Fleet(n_trips=1, minutes=minutes, speed_m_per_s=speed_m_per_s)
    track, journey = np.random.SeedSequence(3).spawn(2)
    return Drive(train, fleet, 500.0, track, journey, **changes)


def test_wheels_out_of_round_excite_each_wheelset_at_its_own_orders():
    plain = RichTrain(frozenset({"roll"}))
    rough = replace(plain, effects={"roll", "out_of_round"}, wheels_seed=4)
    speed, times = 70.0, np.arange(5000) / 500.0
    added = drive(rough).track()(times) - drive(plain).track()(times)
    assert np.abs(added[:, 8:]).max() == 0  # none aside
    f = np.fft.rfftfreq(len(times), 1 / 500.0)
    turning_hz = speed / (2 * math.pi * plain.wheel_radius_m)
    lines = [np.argmin(np.abs(f - order * turning_hz)) for order in range(1, 6)]
    for wave in added[0, :8]:
        power = np.abs(np.fft.rfft(wave * np.hanning(len(wave)))) ** 2
        assert sum(power[i - 2 : i + 3].sum() for i in lines) > 0.999 * power.sum()
        assert 1e-5 < wave.std() < 3e-4
    corr = np.corrcoef(added[0, :4])
    assert np.abs(corr - np.eye(4)).max() < 0.99
    fine = np.arange(2000) / 20_000.0
    moved = drive(rough).track()(fine) - drive(plain).track()(fine)
    for value, derivative in ((0, 1), (1, 2)):
        rise = np.gradient(moved[value], fine, axis=-1)[:, 1:-1]
        size = np.abs(moved[derivative]).max()
        np.testing.assert_allclose(rise, moved[derivative][:, 1:-1], atol=2e-3 * size)


@pytest.mark.parametrize("effect", ["changing_roughness", "welds", "crossings"])
def test_what_the_line_adds_has_its_own_derivatives(effect):
    spectrum = track_spectrum("german_low")
    coarse = [make_profile(spectrum, 20_000.0, 0.5, seed, 500.0) for seed in range(3)]
    profiles = [TrackProfile(0.05, *one.at(np.arange(0.0, 20_000.0, 0.05))) for one in coarse]
    found = rough_profiles(profiles, {effect}, np.random.default_rng(1))
    both = list(zip(found, profiles, strict=True))
    changed = [np.abs(a.elevation_m - b.elevation_m).max() > 1e-5 for a, b in both]
    assert changed == [True, True, effect != "welds"]
    for a, b in both:
        own = [np.array([p.elevation_m, p.slope, p.curvature_per_m]) for p in (a, b)]
        added = own[0] - own[1]
        for value, derivative in ((0, 1), (1, 2)):
            rise = np.gradient(added[value], a.step_m)[1:-1]
            size = np.abs(added[derivative]).max() or 1.0
            np.testing.assert_allclose(rise, added[derivative][1:-1], atol=2e-2 * size)
    same = rough_profiles(profiles, {"heat"}, np.random.default_rng(1))
    np.testing.assert_array_equal(same[0].elevation_m, profiles[0].elevation_m)


def test_heat_softens_the_dampers_and_the_manifest_states_it(tmp_path):
    train, fleet = RichTrain(frozenset({"heat"})), Fleet(n_trips=3, minutes=0.02, sensors=SENSOR)
    paths = write_train_trips(tmp_path, train, np.ones((3, 5)), fleet, 1)
    contents = [yaml.safe_load(path.read_text()) for path in paths]
    warm = [one["temperature_c"] for one in contents]
    assert len(set(warm)) == 3
    assert all(one["truth"]["c_p"] == 1 for one in contents)
    draws = [of_the_trip(train, np.random.default_rng(i)) for i in range(50)]
    for own, celsius in draws:
        assert own.c_p == pytest.approx(1 - 0.004 * (celsius - 15), abs=3e-4)
        assert own.c_s == own.c_p
        assert own.k_p == own.k_s == 1
    assert min(t for _, t in draws) < 0
    assert max(t for _, t in draws) > 28


# reference: sensors


def test_sensors_add_noise_mains_and_steps():
    n, rate_hz = 250_000, 250.0
    silent = np.zeros(n)
    rng = np.random.default_rng
    f, noise = welch(
        recorded({"coloured_noise"}, 1, silent, rate_hz, rng(0)), rate_hz, nperseg=5000
    )
    expected = NOISE[1] ** 2 * (1 + 2.0 / f[1:])
    assert np.median(noise[1:] / expected) == pytest.approx(1, abs=0.05)
    low = (f > 0.4) & (f < 1.0)
    assert np.mean(noise[low] / (NOISE[1] ** 2 * (1 + 2.0 / f[low]))) == pytest.approx(1, abs=0.15)
    f, mains = welch(recorded({"mains"}, 0, silent, rate_hz, rng(0)), rate_hz, nperseg=5000)
    peaks = f[np.argsort(mains)[::-1][:6]]
    assert {round(p / 16.7) for p in peaks} == {1, 3}
    assert 2 * np.trapezoid(mains, f) < 2 * MAINS[0] ** 2
    wave = 3 * np.sin(np.arange(2000) / 50)
    stepped = recorded({"resolution"}, 2, wave, rate_hz, rng(0))
    step = 2 * RANGES_G[2] * g / 2**16
    np.testing.assert_allclose(stepped / step, np.round(stepped / step), atol=1e-6)
    assert 0 < np.abs(stepped - wave).max() <= step / 2 * (1 + 1e-9)
    assert recorded(set(), 2, wave, rate_hz, rng(0)) is wave


def columns(path):
    """Return all recordings of a trip, (n_sensors, n_samples)."""
    tables = [pq.read_table(path.with_suffix("") / f"{name}.parquet") for name in SENSOR]
    return np.array([t[side].to_numpy() for t in tables for side in ("left", "right")])


def test_gains_and_delays_are_those_of_each_sensor(tmp_path):
    fleet = Fleet(
        n_trips=1, minutes=0.1, sensors={k: v | {"snr_db": None} for k, v in SENSOR.items()}
    )
    late = {"late_s_2": 0.004, "late_s_5": 0.008}  # of one and two samples
    train = RichTrain(frozenset({"sensors"}), sensitivity_1=1.02, **late)
    found, plain = (
        columns(write_train_trips(tmp_path / name, one, [WORN], fleet, 1)[0])
        for name, one in (("a", train), ("b", RichTrain()))
    )
    np.testing.assert_allclose(found[1], 1.02 * plain[1], rtol=1e-5)
    np.testing.assert_allclose(found[2, 1:], plain[2, :-1], rtol=1e-5)
    np.testing.assert_allclose(found[5, 2:], plain[5, :-2], rtol=1e-5)
    np.testing.assert_array_equal(found[[0, 3, 4]], plain[[0, 3, 4]])


# property


@pytest.fixture(scope="module")
def trips(tmp_path_factory):
    """Return what writes a short trip with some effects and reads its recordings."""
    made, fleet = {}, Fleet(n_trips=1, minutes=0.05, sensors=SENSOR)

    def trip(*effects):
        if effects not in made:
            train = RichTrain.scattered(1, {"roll", *effects})
            folder = tmp_path_factory.mktemp("trip")
            made[effects] = columns(write_train_trips(folder, train, [HEALTHY], fleet, 1)[0])
        return made[effects]

    return trip


@pytest.mark.parametrize("effect", ROUGH)
def test_each_effect_of_the_rough_train_changes_the_recordings(effect, trips, monkeypatch):
    monkeypatch.setattr("rich_line.CROSSING_EVERY_M", 100.0)
    bushings = ("bushings",) if effect in LAWS else ()
    plain, found = trips(*bushings), trips(*bushings, effect)
    change = (found - plain).std(axis=1) / plain.std(axis=1)
    # the noise of each sensor is 2 %, of numbers of its own where the signal is another one
    assert change.max() > (1e-6 if effect in ("resolution", "coloured_noise") else 5e-4)
    assert np.isfinite(found).all()
