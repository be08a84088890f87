"""Speed of the sensor: shot noise compared with NumPy's, the full chain with shot noise alone.

    python benchmarks/sensor.py

12 Mpx with the means of a room: 50 electrons in nine rows of ten, 0 to 4 000 in the others. Compare ratios within one
run: absolute speeds depend on the machine and its load.
"""

import os
import time
from collections.abc import Callable

import numpy as np

from vlcrender.core.backend import dr
from vlcrender.sensor.poisson import poisson
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROWS, COLUMNS = 3000, 4000
RUNS = 5
FULL = Sensor(
    noise="full",
    prnu=0.01,
    dark_current_e_s=10.0,
    dsnu_e=1.0,
    read_noise_e=2.0,
    adc_noise_dn=0.3,
    row_offset_e=0.2,
    column_offset_e=0.2,
    black_level_dn=64,
)


def best_s(work: Callable[[], object]) -> float:
    """Shortest time of RUNS runs, after one run that compiles."""
    work()
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Measure and print."""
    means = np.full((ROWS, COLUMNS), 50.0, dtype=np.float32)
    means[::10] = np.linspace(0, 4000, COLUMNS, dtype=np.float32)
    generator = np.random.Generator(np.random.PCG64(1))
    numpy_s = best_s(lambda: generator.poisson(means))
    print(f"12 Mpx, 50 e in nine rows of ten, 0 to 4 000 e in the others; best of {RUNS}")
    print(f"numpy.random.Generator.poisson, fastest bit generator{means.size / numpy_s / 1e6:6.1f} M/s")
    for threads in (1, os.cpu_count() or 1):
        dr.set_thread_count(threads)
        draw_s = best_s(lambda: poisson(means, "bench"))
        shot_s = best_s(lambda: expose(Sensor(), means, "bench", exposure_s=0.01))
        full_s = best_s(lambda: expose(FULL, means, "bench", exposure_s=0.01))
        print(f"threads: {threads}")
        print(f"  Poisson draws                    {means.size / draw_s / 1e6:6.1f} M/s")
        print(f"  NumPy / Poisson draws            {numpy_s / draw_s:6.2f}")
        print(f"  exposure, shot noise             {means.size / shot_s / 1e6:6.1f} M/s")
        print(f"  exposure, full chain             {means.size / full_s / 1e6:6.1f} M/s")
        print(f"  full chain / shot noise          {full_s / shot_s:6.2f}")


if __name__ == "__main__":
    main()
