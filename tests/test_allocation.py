"""Memory of freed tensors is used again without asking the system for it."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import torch
from rpg.allocation import keep_freed_memory
torch.set_num_threads(1)
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
x = torch.ones(10_000, 1024)  # 41 MB: more than glibc ever learns to keep by itself
for repeat in range(20):
    if repeat == 10:
        before = faults()
    y = torch.relu(x)
    del y
print(faults() - before)
"""


def page_faults(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are those of glibc")
def test_freed_memory_is_not_mapped_anew() -> None:
    plain, kept = page_faults("plain"), page_faults("keep")
    assert plain > 10 * 1000, "nothing to gain here: the test would pass without the settings"
    assert kept < plain / 10
