"""Sweeps on disk and on many devices: killed and resumed, shared, never mixed with what is damaged or of another sweep."""

import multiprocessing
import random
import resource
import socket
import time

import jax.numpy as jnp
import numpy as np
import pytest
import sweeping

from physjax import sweep
from physjax.study.sweeps import store

AXES = {"x": np.linspace(0.0, 1.0, 40), "y": np.linspace(1.0, 2.0, 25)}
BATCH = 16
# processes that begin with everything imported, and nothing begun
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["physjax.study.sweeps.sweep"])


def start(outs, **options):
    """Sweeps in a process of its own, into the folders (None: memory) by the files of their results."""
    process = PROCESSES.Process(target=sweeping.run, args=(outs,), kwargs={"batch": BATCH} | options)
    process.start()
    return process


def done(*processes):
    for process in processes:
        process.join(timeout=300)
        assert process.exitcode == 0


def same(one, other):
    with np.load(one) as a, np.load(other) as b:
        for name in ("value", "status"):
            np.testing.assert_array_equal(a[name], b[name])


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The results of one process and one device."""
    kept = tmp_path_factory.mktemp("one") / "kept.npz"
    done(start({kept: None}))
    return kept


def product(x, y):
    return {"sum": x + y, "product": jnp.stack([x, y]) * x * y}


def quiet(measure, axes, **options):
    return sweep(measure, axes, progress=False, **options)


def files(folder):
    """Name, inode and time of every finished chunk."""
    return {(p.name, p.stat().st_ino, p.stat().st_mtime_ns) for p in folder.glob("chunk-*.npz")}


@pytest.mark.slow
def test_killed_at_ten_random_moments_and_resumed_it_is_bit_equal_and_nothing_is_computed_twice(
    tmp_path, uninterrupted
):
    out, kept, before, rng = tmp_path / "out", tmp_path / "kept.npz", set(), random.Random()
    for _ in range(10):
        process = start({kept: out})
        until = time.monotonic() + 60
        while len(files(out)) <= len(before) and process.is_alive() and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, 0.02))
        process.kill()
        process.join()
        after = files(out)
        assert before < after, "a finished chunk was written again, or none was added"
        before = after
    assert len(before) < 225, "the kills came too late to mean anything"
    done(start({kept: out}))
    assert before < files(out)
    assert len(files(out)) == 225
    assert not list(out.glob(".chunk-*")), "half a chunk was left behind"
    same(kept, uninterrupted)


def test_two_devices_give_the_bits_of_one(tmp_path, uninterrupted):
    # two blocks of the same size in a batch, one on each
    done(start({tmp_path / "kept.npz": None}, devices=2, batch=2 * BATCH))
    same(tmp_path / "kept.npz", uninterrupted)


def test_two_processes_give_the_bits_of_one_in_memory_and_in_a_folder(tmp_path, uninterrupted):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    outs = [{tmp_path / f"memory{i}.npz": None, tmp_path / f"folder{i}.npz": tmp_path / "out"} for i in (0, 1)]
    done(*(start(outs[i], address=address, process=i) for i in (0, 1)))
    for one in (*outs[0], *outs[1]):
        same(one, uninterrupted)


def test_a_finished_folder_is_read_and_nothing_computed(tmp_path):
    first = quiet(product, AXES, batch=100, out=tmp_path)
    before = files(tmp_path)
    again = quiet(product, AXES, out=tmp_path)
    assert files(tmp_path) == before
    assert len(before) == 10
    loaded = sweep.load(tmp_path)
    for name in ("sum", "product"):
        np.testing.assert_array_equal(again.values[name], first.values[name])
        np.testing.assert_array_equal(loaded.values[name], first.values[name])
    np.testing.assert_array_equal(first.values["sum"], AXES["x"][:, None] + AXES["y"])
    with np.load(sorted(tmp_path.glob("chunk-*"))[3]) as archive:
        np.testing.assert_array_equal(archive["value.sum"], first.values["sum"].ravel()[300:400])


def test_shards_share_the_work_and_what_is_missing_is_said(tmp_path):
    half = quiet(product, AXES, batch=100, out=tmp_path, shard=(1, 2))
    assert half.failures == {"not computed yet": 500}
    assert half.reason((0, 0)) == "not computed yet"
    whole = quiet(product, AXES, batch=100, out=tmp_path, shard=(0, 2))
    assert whole.ok.all()
    with pytest.raises(ValueError, match=r"shard: got \(2, 2\), expected"):
        quiet(product, AXES, shard=(2, 2))


@pytest.mark.parametrize("spot", [0.0, 0.3, 0.999])
def test_a_flipped_byte_is_told_by_the_name_of_its_chunk(tmp_path, spot):
    quiet(product, AXES, batch=100, out=tmp_path)
    path = sorted(tmp_path.glob("chunk-*"))[4]
    content = bytearray(path.read_bytes())
    content[int(spot * len(content))] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"the chunk .*{path.name} is damaged.*Delete it"):
        quiet(product, AXES, out=tmp_path)
    with pytest.raises(ValueError, match=path.name):
        _ = sweep.load(tmp_path).values
    path.unlink()
    assert quiet(product, AXES, out=tmp_path).ok.all()


def test_a_chunk_cut_short_or_of_another_sweep_is_told_by_its_name(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    quiet(product, AXES, batch=100, out=one)
    quiet(product, AXES | {"x": np.linspace(0.0, 1.5, 40)}, batch=100, out=other)
    path = sorted(one.glob("chunk-*"))[2]
    content = path.read_bytes()
    path.write_bytes(content[:-1000])
    with pytest.raises(ValueError, match=f"{path.name} is damaged"):
        quiet(product, AXES, out=one)
    path.unlink()
    foreign = sorted(other.glob("chunk-*"))[2]
    (one / foreign.name).write_bytes(foreign.read_bytes())
    with pytest.raises(ValueError, match=f"{foreign.name} belongs to another sweep"):
        quiet(product, AXES, out=one)
    (one / foreign.name).rename(one / "chunk-00000099-of-mine.npz")
    with pytest.raises(ValueError, match=r"chunk-00000099-of-mine.npz is not a chunk of this sweep of 10"):
        quiet(product, AXES, out=one)


def test_a_folder_of_another_sweep_is_refused_with_the_difference(tmp_path):
    scaled = lambda factor: lambda x, y: {"sum": factor * (x + y), "product": jnp.stack([x, y]) * x * y}  # noqa: E731
    quiet(scaled(2.0), AXES, batch=100, out=tmp_path)
    before = files(tmp_path)
    for measure, axes, options, told in (
        (scaled(2.0), AXES | {"y": AXES["y"] + 1e-12}, {}, r"other values on the axes \(y: "),
        (scaled(2.1), AXES, {}, "another measure, or one with other constants"),
        (scaled(2.0), AXES, {"batch": 50}, r"another number of lanes in a chunk \(100 there, 50 here\)"),
        (lambda x, y: x, AXES, {}, "other results"),
    ):
        with pytest.raises(ValueError, match=f"holds another sweep: .*{told}"):
            quiet(measure, axes, out=tmp_path, **options)
    assert files(tmp_path) == before
    assert quiet(scaled(2.0), AXES, out=tmp_path).ok.all()  # the same function, made anew


def test_a_manifest_that_was_changed_is_refused(tmp_path):
    quiet(product, AXES, batch=100, out=tmp_path)
    manifest = tmp_path / store.MANIFEST
    manifest.write_text(manifest.read_text().replace('"batch": 100', '"batch": 101'))
    with pytest.raises(ValueError, match=r"manifest.json is damaged"):
        quiet(product, AXES, out=tmp_path)


def test_axes_that_are_not_those_of_the_folder_are_refused(tmp_path):
    quiet(product, AXES, batch=100, out=tmp_path)
    np.savez(tmp_path / "axes.npz", **{"axis.x": AXES["x"], "axis.y": AXES["y"][::-1]})
    with pytest.raises(ValueError, match=r"axes.npz does not hold the axes of this sweep"):
        sweep.load(tmp_path)
    (tmp_path / "axes.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"axes.npz is damaged"):
        sweep.load(tmp_path)


def test_a_folder_in_use_is_refused_unless_both_share(tmp_path):
    quiet(product, AXES, batch=100, out=tmp_path, shard=(0, 2))
    manifest = store.found(tmp_path).manifest
    with (
        store.open_folder(tmp_path, manifest, (0, 1), {}),
        pytest.raises(ValueError, match="another process is working"),
    ):
        quiet(product, AXES, out=tmp_path, shard=(1, 2))
    with store.open_folder(tmp_path, manifest, (0, 2), {}):
        for shard in (None, (0, 2)):
            with pytest.raises(ValueError, match=r"another process is working.*shard="):
                quiet(product, AXES, out=tmp_path, shard=shard)
        assert quiet(product, AXES, out=tmp_path, shard=(1, 2)).ok.all()


def test_a_full_disk_is_told_and_finished_chunks_are_intact(tmp_path):
    quiet(product, AXES, batch=500, out=tmp_path, shard=(0, 2))
    before, limit = files(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, limit[1]))  # a chunk takes 14 kB
    try:
        with pytest.raises(OSError, match=r"cannot write chunk 1 of 2 into .*: File too large. .* chunks are intact"):
            quiet(product, AXES, out=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert files(tmp_path) == before
    assert not list(tmp_path.glob(".chunk-*"))
    assert quiet(product, AXES, out=tmp_path).ok.all()
    assert before < files(tmp_path)


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match=r"cannot write into .*file"):
        quiet(product, AXES, out=tmp_path / "file")
