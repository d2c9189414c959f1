"""Every effect does what its name says: checked against the equations in the frequency domain.

A settled orbit must satisfy the balance of physics.md §1, written here a second time and by
other means: with F_k the coefficients of f(z(t − τ)),

    (ω_i² − k²ω² + 2jζ_i ω_i kω) η_i,k = ψ_i jkω F_k + ψ_a,i g A(jkω) U_k − loss,
    Y_k = Σ D_i jkω η_i,k,   Z_k = k_f G(jkω) Y_k.

z is sampled at 50 kHz, so F_k from its samples is exact up to aliasing of harmonics beyond the
140th. Remaining: the integrator's error, 1e-9 at this step, and settling. Held to 1e-6 of |Y₁|.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simulated_rig import EFFECTS, build_config, make_effect, seal
from simulated_rig.actuator import DrivePath, distorted
from simulated_rig.campaigns import (
    PlannedRun,
    simulate_campaign,
    simulate_run,
    write_campaign,
)
from simulated_rig.config import RigConfig
from simulated_rig.cycle import free_amplitude
from simulated_rig.simulation import Simulation, propagator

RATE = 50000.0
FREQUENCY = 168.0
VOLTS = 1.0
K = np.arange(1, 6)
S = 2j * np.pi * FREQUENCY * K


def orbit(config: RigConfig) -> tuple[np.ndarray, np.ndarray]:
    """One second of Y (table's unit) and z on the settled orbit, from a multiple of 1 s on."""
    plant = config.plant
    simulation = Simulation(propagator(plant, config.microphones_m, 1 / RATE))
    count = round(8 * 2 * RATE)
    t = np.arange(1, count + 1) / (2 * RATE)
    volts = DrivePath(plant.actuator, 2 * RATE).process(
        VOLTS * np.sin(2 * np.pi * np.mod(FREQUENCY * t, 1.0))
    )
    out = simulation.run(np.concatenate([[0.0], volts]))[-round(RATE) :]
    return out[:, 0] / plant.velocity_scale, out[:, 1]


def coefficients(values: np.ndarray) -> np.ndarray:
    t = np.arange(values.size) / RATE
    return 2 * np.mean(values * np.exp(-S[:, None] * t), axis=1)


def balance_error(
    config: RigConfig,
    flame: Callable[[np.ndarray], np.ndarray] = lambda s: np.ones_like(s),
    actuator: Callable[[np.ndarray], np.ndarray] = lambda s: np.ones_like(s),
    characteristic: Callable[[np.ndarray], np.ndarray] | None = None,
    seen_delay_s: float = 0.0,
    drive: np.ndarray | None = None,
) -> float:
    """Largest relative error of both halves of the loop."""
    y, z = orbit(config)
    plant = config.plant
    yk, zk = coefficients(y), coefficients(z)
    expected_z = 30.0 / (S + 2 * np.pi * 100.0) * flame(S) * yk
    seen = np.fft.irfft(
        np.fft.rfft(z) * np.exp(-2j * np.pi * np.arange(z.size // 2 + 1) * seen_delay_s), z.size
    )
    if characteristic is None:
        fk = coefficients(22.5 * seen - 15000 * (seen / 4000) ** 2 - 200 * (seen / 4000) ** 3)
    else:
        fk = coefficients(characteristic(seen))
    uk = np.array([-1j * VOLTS, 0, 0, 0, 0]) if drive is None else drive
    expected_y = np.zeros(K.size, dtype=complex)
    for f, zeta, psi, d, speaker in TABLE:
        w = 2 * np.pi * f
        denominator = w**2 + S**2 + 2 * zeta * w * S
        expected_y += d * S * (psi * S * fk + speaker * 1e10 * actuator(S) * uk) / denominator
    assert plant.actuator.gain == 1e10
    size_y, size_z = abs(yk[0]), abs(zk[0])
    return float(
        max(np.max(np.abs(expected_y - yk)) / size_y, np.max(np.abs(expected_z - zk)) / size_z)
    )


TABLE = [(168.79, 0.010, -0.41, -0.16, -0.22), (281.33, 0.050, -0.24, 0.10, -0.34)]
CUBIC = np.polynomial.Polynomial([0.0, 22.5, -15000 / 4000**2, -200 / 4000**3])


def rig(key: str, **parameters: float) -> RigConfig:
    return make_effect(key, parameters).apply(build_config())


def test_no_effect() -> None:
    assert balance_error(build_config()) < 1e-6


def test_the_balance_is_sensitive() -> None:
    """The check itself: a delay of 10 µs that the balance does not know must show."""
    assert balance_error(rig("flame_delay", delay_s=2e-5)) > 1e-4


@pytest.mark.parametrize("delay_s", [2e-5, 1.234e-4, 4e-4, 1.1e-3])
def test_flame_delay(delay_s: float) -> None:
    assert balance_error(rig("flame_delay", delay_s=delay_s), seen_delay_s=delay_s) < 1e-6


def test_flame_pole() -> None:
    config = rig("flame_dynamics", pole_hz=700.0)
    assert balance_error(config, flame=lambda s: 1 / (1 + s / (2 * np.pi * 700))) < 1e-6


def test_second_time_scale() -> None:
    config = rig("flame_dynamics", slow_share=0.2, slow_pole_hz=30.0)
    assert balance_error(config, flame=lambda s: 0.8 + 0.2 / (1 + s / (2 * np.pi * 30.0))) < 1e-6


def test_distributed_delay() -> None:
    config = rig("flame_dynamics", mean_delay_s=5e-4)
    assert balance_error(config, flame=lambda s: (1 + s * 5e-4 / 3) ** -3) < 1e-6


@pytest.mark.parametrize(("name", "power"), [("quartic_share", 4), ("quintic_share", 5)])
def test_higher_powers(name: str, power: int) -> None:
    sign = -1 if power == 5 else 1
    z = free_amplitude(build_config().plant)
    share = 0.05
    config = rig("nonlinearity_shape", **{name: share})

    def shape(s: np.ndarray) -> np.ndarray:
        return CUBIC(s) + sign * share * 22.5 * s * (s / z) ** (power - 1)

    assert balance_error(config, characteristic=shape) < 1e-6


def test_saturation() -> None:
    width = 3.0 * free_amplitude(build_config().plant)
    config = rig("nonlinearity_shape", saturation_width=3.0)
    assert balance_error(config, characteristic=lambda s: CUBIC(width * np.tanh(s / width))) < 1e-6


def test_dead_zone() -> None:
    """A kink costs the integrator its order: 1e-5."""
    width = 0.05 * free_amplitude(build_config().plant)
    config = rig("nonlinearity_shape", dead_zone_width=0.05)

    def shape(s: np.ndarray) -> np.ndarray:
        return CUBIC(np.sign(s) * np.maximum(np.abs(s) - width, 0.0))

    assert balance_error(config, characteristic=shape) < 1e-5


def test_hysteresis() -> None:
    """Backlash of half-width w by its definition, run twice over the period; kinks: 1e-5."""
    width = 0.03 * free_amplitude(build_config().plant)
    config = rig("nonlinearity_shape", hysteresis_width=0.03)

    def shape(s: np.ndarray) -> np.ndarray:
        held, played = 0.0, np.empty(s.size)
        for _ in range(2):
            for i, value in enumerate(s):
                held = min(max(held, value - width), value + width)
                played[i] = held
        return CUBIC(played)

    assert balance_error(config, characteristic=shape) < 1e-5


def test_speaker_resonance() -> None:
    config = rig("actuator_dynamics", resonance_hz=140.0, damping=0.12)
    w = 2 * np.pi * 140.0
    assert balance_error(config, actuator=lambda s: w**2 / (s**2 + 2 * 0.12 * w * s + w**2)) < 1e-6


def test_voice_coil() -> None:
    config = rig("actuator_dynamics", pole_hz=500.0)
    assert balance_error(config, actuator=lambda s: 1 / (1 + s / (2 * np.pi * 500.0))) < 1e-6


def test_coil_cone_and_plenum_in_series() -> None:
    plain = build_config()
    speaker = replace(
        plain.plant.actuator,
        pole_hz=600.0,
        resonance_hz=240.0,
        damping=0.25,
        plenum_hz=700.0,
        plenum_damping=0.08,
    )
    config = replace(plain, plant=replace(plain.plant, actuator=speaker))

    def response(s: np.ndarray) -> np.ndarray:
        out = 1 / (1 + s / (2 * np.pi * 600.0))
        for hz, zeta in ((240.0, 0.25), (700.0, 0.08)):
            x = s / (2 * np.pi * hz)
            out = out / (x**2 + 2 * zeta * x + 1)
        return np.asarray(out)

    assert balance_error(config, actuator=response) < 1e-6


@pytest.mark.parametrize("delay_s", [7e-6, 3.3e-4])
def test_speaker_delay(delay_s: float) -> None:
    config = rig("actuator_dynamics", delay_s=delay_s)
    assert balance_error(config, actuator=lambda s: np.exp(-s * delay_s)) < 1e-6


@pytest.mark.parametrize(
    ("key", "parameters"),
    [
        ("actuator_nonlinearity", {"cubic_per_v2": 0.02}),
        ("actuator_nonlinearity", {"quadratic_per_v": 0.05}),
        ("actuator_nonlinearity", {"clip_v": 0.9}),
    ],
)
def test_speaker_distortion(key: str, parameters: dict[str, float]) -> None:
    config = rig(key, **parameters)
    t = np.arange(round(RATE)) / RATE
    volts = distorted(config.plant.actuator, VOLTS * np.sin(2 * np.pi * FREQUENCY * t))
    assert abs(coefficients(volts)[0] + 1j * VOLTS) > 1e-3 or abs(coefficients(volts)[1]) > 1e-3
    assert balance_error(config, drive=coefficients(volts)) < 1e-6


def test_further_mode() -> None:
    config = rig(
        "acoustic_mode",
        frequency_hz=393.86,
        damping=0.05,
        flame_residue_ratio=0.2,
        speaker_residue_ratio=-0.1,
    )
    extra = config.plant.modes[-1]
    first = config.plant.modes[0]
    assert extra.psi_flame * extra.velocity == pytest.approx(0.2 * first.psi_flame * first.velocity)
    row = (393.86, 0.05, extra.psi_flame, extra.velocity, extra.psi_speaker)
    TABLE.append(row)
    try:
        assert balance_error(config) < 1e-6
    finally:
        TABLE.remove(row)


@pytest.mark.parametrize(
    ("parameters", "law"),
    [
        ({"quadratic_per_m": 10.0}, lambda u: 10.0 * np.abs(u) * u),
        ({"cubic_s_per_m2": 10.0}, lambda u: 10.0 * u**3),
    ],
)
def test_open_end_loss(
    parameters: dict[str, float], law: Callable[[np.ndarray], np.ndarray]
) -> None:
    """One mode, no flame: (ω² + S² + 2ζωS) η_k = ψ_a g U_k − Λ_k, where the force Λ = λ(u)/(D_L s)
    makes λ(u)/u the added damping rate: with u = D_L s η', Λ = (λ(u)/u) η'.

    λ has a kink in its second derivative (|u|u), hence 1e-5.
    """
    config = rig("nonlinear_damping", **parameters)
    plant = replace(config.plant, modes=config.plant.modes[:1], lit=False)
    mode = plant.modes[0]
    y, _ = orbit(replace(config, plant=plant))
    rate = y / mode.velocity  # η'
    u = plant.velocity_at(mode, plant.open_end.length_m) * plant.velocity_scale * rate
    lost = coefficients(law(u) / np.where(u == 0.0, 1.0, u) * rate)
    w = 2 * np.pi * mode.frequency_hz
    drive = np.array([-1j * VOLTS, 0, 0, 0, 0])
    denominator = w**2 + S**2 + 2 * mode.damping * w * S
    expected = S * (mode.psi_speaker * 1e10 * drive - lost) / denominator
    found = coefficients(rate)
    assert np.max(np.abs(expected - found)) < 1e-5 * abs(found[0])
    assert abs(lost[0]) > 0.1 * abs(mode.psi_speaker * 1e10 * VOLTS)


def recorded(config: RigConfig, **change: float) -> np.ndarray:
    """Two-microphone velocity, three harmonics, of a noiseless recording."""
    quiet = replace(
        config,
        microphones=tuple(replace(m, noise_pa=0.0) for m in config.microphones),  # type: ignore[arg-type]
        converter=replace(config.converter, bits=24),
    )
    run = simulate_run(quiet, PlannedRun("forced", FREQUENCY, VOLTS, duration_s=1.0), [0])
    t = np.arange(run.p1.size) / 1e4
    turn = 2 * np.exp(-S[:3, None] * t) / t.size
    return np.stack([turn @ run.p1, turn @ run.p2])


def test_microphone_faults() -> None:
    plain = recorded(build_config())
    gain = recorded(rig("channel_mismatch", gain=0.02))
    assert gain[0] == pytest.approx(plain[0], rel=1e-9)
    assert gain[1] == pytest.approx(1.02 * plain[1], rel=1e-6)
    skew = recorded(rig("channel_mismatch", skew_s=2e-5))
    # Ripple is 130 dB down; 24-bit steps of 6e-4 Pa beside 8 Pa, averaged over 1e4 samples.
    assert skew[1] == pytest.approx(np.exp(-S[:3] * 2e-5) * plain[1], rel=1e-6)
    slow = recorded(rig("channel_mismatch", lowpass_hz=3000.0))
    # The cubic's error at 20 kHz steps and the third harmonic, (ωΔt)⁴/100: 6e-6.
    assert slow[1] == pytest.approx(plain[1] / (1 + S[:3] / (2 * np.pi * 3000)), rel=2e-5)


def test_sensor_offset_follows_the_mode_shapes() -> None:
    """D(x) ∝ sin kx: the modes' shares of the velocity change, the loop does not."""
    offset = 0.05
    near, far = recorded(build_config()), recorded(rig("sensor_offset", offset_m=offset))
    y, _ = orbit(build_config())
    assert near[0] == pytest.approx(far[0], rel=0.2)
    velocity = [-(p[1] - p[0]) / (1.2 * 0.0508 * S[:3]) for p in (near, far)]
    k = 3 * np.pi / (2 * 1.524)
    expected = np.sin(k * (0.762 + offset)) / np.sin(k * 0.762)
    # The fundamental is the first mode's but for a few percent of the second.
    assert abs(velocity[1][0] / velocity[0][0]) == pytest.approx(expected, rel=0.03)
    assert abs(velocity[0][0]) == pytest.approx(abs(coefficients(y)[0]) * 1e-7, rel=1e-4)


@pytest.mark.parametrize("key", sorted(EFFECTS))
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_every_effect_shows_and_more_so_when_gross(key: str, size: float) -> None:
    effect = EFFECTS[key].draw(np.random.default_rng(3), size)
    config = effect.apply(build_config())
    assert config != build_config()
    late = [
        simulate_run(c, PlannedRun("forced", FREQUENCY, VOLTS, 1200.0, duration_s=0.5), [4, 1])
        for c in (build_config(), config)
    ]
    assert np.all(np.isfinite(late[1].p2))
    changed = np.std(late[1].p2 - late[0].p2)
    # Same noise in both: even the barely visible change something beyond the converter's step.
    assert changed > (0.01 if size == 0.0 else 0.5)


def test_parameters_carry_units_and_effects_refuse_what_they_do_not_know() -> None:
    told = make_effect("actuator_dynamics", {"pole_hz": 800.0}).parameters()
    assert told == {"pole_hz": {"value": 800.0, "unit": "Hz"}}
    with pytest.raises(ValueError, match="'ghost' is not one of"):
        make_effect("ghost", {})
    with pytest.raises(ValueError, match="parameters="):
        make_effect("flame_delay", {"pole_hz": 1.0})


def test_a_seal_is_drawn_from_its_seed_and_tells_only_when_asked() -> None:
    for seed in range(5):
        one, same = seal(seed), seal(seed)
        assert one.reveal() == same.reveal()
        assert set(one.reveal()) >= {"effect", "location", "parameters"}
        assert str(one.reveal()["effect"]) not in repr(one)
        assert one.apply(build_config()) == same.apply(build_config()) != build_config()
    drawn = {str(seal(seed).reveal()["effect"]) for seed in range(30)}
    assert len(drawn) >= 4


def test_the_answer_key_is_written_apart(tmp_path: Path) -> None:
    """A sealed campaign's files do not tell what its key does."""
    sealed = seal(3)
    config = sealed.apply(build_config())
    plan = [PlannedRun("free", duration_s=0.1)]
    folder = write_campaign(simulate_campaign(config, plan, 3), tmp_path / "campaign")
    with pytest.raises(ValueError, match="put it apart"):
        sealed.write_key(folder / "runs" / "key.json")
    key = json.loads(sealed.write_key(tmp_path / "campaign.key.json").read_text())
    assert key == {"format": "answer-key/1", **sealed.reveal()}
    plain = write_campaign(simulate_campaign(build_config(), plan, 3), tmp_path / "plain")
    assert (folder / "campaign.toml").read_text() == (plain / "campaign.toml").read_text()
    names = [sorted(p.name for p in f.rglob("*")) for f in (folder, plain)]
    assert names[0] == names[1]
