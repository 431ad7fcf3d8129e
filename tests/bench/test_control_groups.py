import pytest

from econgs_bench.bench.machine.control_groups import cpu_quota, memory_limit


def tree(folder, groups, files):
    """Mounts and the file of a process's groups."""
    (folder / "own").write_text(groups)
    for name, text in files.items():
        path = folder / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "root", folder / "own"


@pytest.mark.parametrize(
    ("groups", "files", "quota"),
    [
        ("0::/a/b\n", {"a/cpu.max": "150000 100000\n", "a/b/cpu.max": "max 100000\n"}, 1.5),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "50000 100000\n"}, 0.5),
        ("0::/\n", {"cpu.max": "max 100000\n"}, None),
        (
            "4:memory:/m\n3:cpu,cpuacct:/c\n0::/\n",
            {"cpu,cpuacct/c/cpu.cfs_quota_us": "200000\n", "cpu,cpuacct/c/cpu.cfs_period_us": "100000\n"},
            2.0,
        ),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ("0::/gone\n", {}, None),
    ],
)
def test_the_quota_is_the_least_of_all_levels(tmp_path, groups, files, quota):
    assert cpu_quota(*tree(tmp_path, groups, files)) == quota


@pytest.mark.parametrize(
    ("groups", "files", "limit"),
    [
        ("0::/a/b\n", {"a/memory.max": "1000\n", "a/b/memory.max": "max\n"}, 1000),
        ("0::/a/b\n", {"memory.max": "700\n", "a/b/memory.max": "900\n"}, 700),
        ("9:memory:/m\n3:cpu:/c\n", {"memory/m/memory.limit_in_bytes": "500\n"}, 500),
        ("0::/gone\n", {}, None),
    ],
)
def test_the_limit_of_memory_is_the_least_of_all_levels(tmp_path, groups, files, limit):
    assert memory_limit(*tree(tmp_path, groups, files)) == limit


def test_a_system_without_control_groups_has_no_limits(tmp_path):
    assert cpu_quota(tmp_path, tmp_path / "none") is None
    assert memory_limit(tmp_path, tmp_path / "none") is None
