"""Numbers leave the model with nine significant digits: noise in what it computes from does not reach the bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fogspec.compile.compiler import compile_application
from fogspec.compile.inputs import Inputs
from fogspec.model import fit
from fogspec.numerics import surrogate
from fogspec.numerics.families import fit_all
from fogspec.numerics.kernels import Floats, quantised
from fogspec.numerics.observations import observations, pooled
from tests.support.machines import amdahl, family

ROOT = Path(__file__).resolve().parents[3]
NOISE = 1e-13


def test_nine_digits() -> None:
    values = np.array([0.0, 1.0, 0.026, -3.649658740960, 1234567891.5, 9.9999999999, np.inf, -np.inf, 5e-324])
    assert quantised(values).tolist() == [0, 1, 0.026, -3.64965874, 1234567890, 10, np.inf, -np.inf, 0]
    assert np.isnan(quantised(np.array([np.nan]))).all()
    random = np.random.default_rng(0)
    values = random.normal(size=2000) * 10.0 ** random.integers(-200, 200, 2000)
    np.testing.assert_allclose(quantised(values), values, rtol=5.01e-9)
    assert quantised(quantised(values)).tolist() == quantised(values).tolist()


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_another_processor_does_not_reach_the_compiled_files(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    random = np.random.default_rng(seed)

    def noisy(values: Floats) -> Floats:
        return np.asarray(values * (1 + NOISE * random.uniform(-1, 1, np.shape(values))))

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(surrogate, "pooled", lambda samples: (pooled(samples)[0], *map(noisy, pooled(samples)[1:])))
    monkeypatch.setattr(fit, "fit_all", lambda vcpus, memory, values: fit_all(vcpus, memory, noisy(values)))
    specs = sorted(str(path) for path in Path("specs").glob("*-recorded.yaml"))
    for inputs in Inputs.load(specs, catalog="snapshot"):
        compiled = compile_application(inputs)
        assert [str(path) for path, content in compiled.files.items() if inputs.content(path) != content] == []


def test_the_model_does_not_amplify_noise() -> None:
    machines, at = family(), [0, 1, 3, 6, 8, 10, 13, 17]
    space = surrogate.prepare(machines)
    posterior = space.fit(observations(at, amdahl(machines, 0.1)[at]))
    shifted = replace(
        space, ensemble=replace(space.ensemble, features=[one * (1 + 1e-15) for one in space.ensemble.features])
    )
    noisy = shifted.fit(observations(at, amdahl(machines, 0.1)[at]))
    for before, after in ((posterior.means, noisy.means), (posterior.variances, noisy.variances)):
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-11)  # logarithms, which may be about 0
