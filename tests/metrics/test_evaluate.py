"""`overfly evaluate`'s body: its keys, its order of steps, its refusals."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from overfly.cloud import Cloud, read_cloud, write_cloud
from overfly.errors import InputError
from overfly.geodesy import Origin, crs_from_enu
from overfly.metrics import functional as f
from overfly.metrics.evaluate import evaluate, format_table

KEYS = {
    "chamfer_m2", "chamfer_m", "chamfer_sum_1024", "emd_sum_1024", "emd_m", "fscore", "precision", "recall",
    "accuracy_median_m", "accuracy_p90_m", "completeness_1m", "hausdorff_m", "points", "reference_points", "aligned",
    "transform",
}  # fmt: skip
UTM = np.array([576_714.97, 5_188_161.59, 162.28])


def surface(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 40, n), rng.uniform(0, 30, n)
    return np.column_stack([x, y, np.where((abs(x - 20) < 5) & (abs(y - 12) < 4), 6, np.sin(x / 9) + np.cos(y / 7))])


def test_keys_and_values(tmp_path: Path) -> None:
    a, b = surface(3000, 1), surface(4000, 2)
    write_cloud(Cloud(a), tmp_path / "a.ply")
    write_cloud(Cloud(b), tmp_path / "b.ply")
    result = evaluate(tmp_path / "a.ply", tmp_path / "b.ply", voxel_m=0, clip_m=np.inf, gsd_m=0.1)
    assert result.keys() >= KEYS
    for shares in (result["fscore"], result["precision"], result["recall"]):
        assert list(shares) == ["0.25", "0.5", "1.0", "2.0"]
    assert result["chamfer_m2"] == pytest.approx(f.chamfer_m2(a, b))
    assert result["fscore"]["0.5"] == pytest.approx(f.fscore(a, b, 0.5))
    assert result["completeness_1m"] == f.recall(a, b, 1.0)
    assert result["fscore_gsd"]["5"] == pytest.approx(f.fscore(a, b, 0.5))
    assert result["emd_sum_1024"] == pytest.approx(1024 * result["emd_m"])
    assert (result["points"], result["reference_points"], result["aligned"]) == (3000, 4000, "none")
    assert result["transform"] == np.eye(4).tolist()
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert evaluate(tmp_path / "a.ply", tmp_path / "b.ply", voxel_m=0, clip_m=np.inf, gsd_m=0.1) == result


def test_identical_clouds_are_perfect() -> None:
    result = evaluate(Cloud(surface(2000)), Cloud(surface(2000)))
    assert result["chamfer_m2"] == result["hausdorff_m"] == 0
    assert result["fscore"]["0.25"] == result["completeness_1m"] == 1


def test_what_sampling_alone_makes_of_the_1024_points_is_told() -> None:
    """A cloud that is the reference has an EMD above 0: both are drawn anew."""
    result = evaluate(Cloud(surface(6000)), Cloud(surface(6000)), voxel_m=0)
    assert 0 < result["emd_m"] == pytest.approx(result["emd_floor_m"], rel=0.3)
    assert 0 < result["chamfer_sum_1024"] == pytest.approx(result["chamfer_sum_1024_floor"], rel=0.3)
    console = Console(width=150, record=True, file=io.StringIO())
    console.print(format_table(result))
    assert f"{result['emd_floor_m']:.3f}" in console.export_text()


def test_a_reference_too_small_for_two_samples_has_no_floor() -> None:
    result = evaluate(Cloud(surface(1500)), Cloud(surface(1500)), voxel_m=0)
    assert result["emd_floor_m"] is result["chamfer_sum_1024_floor"] is None
    console = Console(width=150, record=True, file=io.StringIO())
    console.print(format_table(result))
    assert "two samples" not in console.export_text()


def test_a_reference_sparser_than_the_thresholds_is_warned_of() -> None:
    sparse, dense = Cloud(surface(2000)), Cloud(surface(200_000))
    assert any("0.37 m apart" in warning and "denser" in warning for warning in evaluate(dense, sparse)["warnings"])
    assert not any("denser" in warning for warning in evaluate(sparse, dense)["warnings"])


def test_voxels_even_out_density_and_clip_drops_what_the_reference_cannot_judge() -> None:
    reference = surface(8000, 2)
    dense_spot = np.tile(surface(1, 3), (5000, 1)) + np.array([0, 0, 9.0])
    outside = surface(500, 4) + np.array([200, 0, 0])
    cloud = Cloud(np.vstack([surface(8000, 1), dense_spot, outside]))
    result = evaluate(cloud, Cloud(reference))
    assert result["points"] == 13_500
    assert result["precision"]["1.0"] > 0.99, "5000 equal wrong points count once, far ones not at all"
    assert 0.03 < result["clipped_share"] < 0.09
    raw = evaluate(cloud, Cloud(reference), voxel_m=0, clip_m=np.inf)
    assert raw["precision"]["1.0"] == pytest.approx(8000 / 13_500, abs=0.01)
    assert raw["clip_m"] is None
    missing = evaluate(Cloud(surface(8000, 1)[surface(8000, 1)[:, 0] < 20]), Cloud(reference))
    assert missing["recall"]["1.0"] < 0.6, "the reference is not clipped"


def test_clip_follows_a_sparse_reference() -> None:
    result = evaluate(Cloud(surface(3000)), Cloud(surface(100, 5) * [10, 10, 1]))
    assert result["clip_m"] > 10


def test_shift_is_found_and_reported() -> None:
    shift = np.array([0.5, -0.8, 10])
    result = evaluate(Cloud(surface(9000, 1) - shift), Cloud(surface(12_000, 2)), align="shift")
    np.testing.assert_allclose(np.array(result["transform"])[:3, 3], shift, atol=0.1)
    assert result["fscore"]["0.5"] > 0.95
    assert result["aligned"] == "shift"
    assert evaluate(Cloud(surface(9000, 1) - shift), Cloud(surface(12_000, 2)))["fscore"]["0.5"] < 0.2


def test_frames() -> None:
    utm, local = Cloud(surface(3000) + UTM, epsg=32615), Cloud(surface(3000, 1))
    with pytest.raises(InputError, match="EPSG:32615, the reference in EPSG:32616"):
        evaluate(utm, Cloud(utm.points, epsg=32616), align="shift")
    with pytest.raises(InputError, match=r"cloud has no CRS .* --align"):
        evaluate(local, utm)
    with pytest.raises(InputError, match=r"reference has no CRS .* --align"):
        evaluate(utm, local)
    unnamed = evaluate(Cloud(utm.points), utm)
    assert unnamed["hausdorff_m"] == 0
    assert "names no CRS" in unnamed["warnings"][0]
    laid = evaluate(local, utm, align="shift")
    np.testing.assert_allclose(np.array(laid["transform"])[:3, 3], UTM, atol=0.3)
    assert "by shift" in laid["warnings"][0]


def test_heights_that_refer_to_different_things_are_told_refused_or_laid_upon_each_other() -> None:
    plain, sea, other = (
        Cloud(surface(9000) + UTM, epsg=32615, vertical_epsg=vertical) for vertical in (None, 5773, 3855)
    )
    same = evaluate(sea, sea)
    assert (same["epsg"], same["vertical_epsg"], same["warnings"]) == (32615, 5773, [])
    for cloud, reference in ((plain, sea), (sea, plain)):
        assert "heights over ellipsoid and sea differ" in evaluate(cloud, reference)["warnings"][0]
    with pytest.raises(InputError, match=r"in EPSG:32615\+5773, the reference in EPSG:32615\+3855: reproject"):
        evaluate(sea, other)
    for cloud, reference in ((plain, sea), (sea, plain), (sea, other)):
        assert "laid upon each other by shift" in evaluate(cloud, reference, align="shift")["warnings"][0]
    with pytest.raises(InputError, match=r"EPSG:32616, the reference in EPSG:32615\+5773"):
        evaluate(Cloud(plain.points, epsg=32616), sea, align="shift")
    assert "in that of the reference, EPSG:32615+5773" in evaluate(Cloud(sea.points), sea)["warnings"][0]


def test_the_reference_of_a_flight_folder_is_brought_to_the_crs_of_its_map(tmp_path: Path) -> None:
    origin = Origin(46.0, 8.0, 450.0, 32632)
    local = np.random.default_rng(0).uniform(0, 30, (500, 3))
    (tmp_path / "transforms.json").write_text(
        json.dumps({"overfly": {"origin": {"latitude": 46.0, "longitude": 8.0, "height": 450.0, "epsg": 32632}}})
    )
    write_cloud(Cloud(local), tmp_path / "reference.ply")
    mapped = Cloud(crs_from_enu(local + np.array([0, 0, 0.5]), origin), epsg=32632)
    (tmp_path / "map").mkdir()
    write_cloud(mapped, tmp_path / "map" / "cloud.ply")
    result = evaluate(tmp_path / "map" / "cloud.ply", tmp_path / "reference.ply", voxel_m=0)
    assert result["accuracy_median_m"] <= 0.5 + 1e-6
    assert result["epsg"] == 32632
    assert "local frame" in result["warnings"][0]


def test_small_clouds_are_scaled_up_to_1024() -> None:
    a, b = np.array([[0, 0, 0.0]]), np.array([[0, 0, 0.5]])
    result = evaluate(Cloud(a), Cloud(b))
    assert result["chamfer_sum_1024"] == pytest.approx(2 * 0.25 * 1024)
    assert result["emd_sum_1024"] == pytest.approx(0.5 * 1024)
    assert result["subset_points"] == 1


def test_refusals(tmp_path: Path) -> None:
    cloud = Cloud(surface(50))
    with pytest.raises(InputError, match="does not exist"):
        evaluate(tmp_path / "none.laz", cloud)
    with pytest.raises(InputError, match="'icp' is unknown"):
        evaluate(cloud, cloud, align="icp")
    with pytest.raises(InputError, match="--align shift"):
        evaluate(Cloud(cloud.points + 500), cloud)
    with pytest.raises(InputError, match="thresholds"):
        evaluate(cloud, cloud, thresholds_m=(0.5, -1))
    with pytest.raises(InputError, match="voxel"):
        evaluate(cloud, cloud, voxel_m=-1)
    with pytest.raises(InputError, match="clip"):
        evaluate(cloud, cloud, clip_m=0)
    with pytest.raises(InputError, match="ground sampling"):
        evaluate(cloud, cloud, gsd_m=0)


def test_table() -> None:
    result = evaluate(Cloud(surface(2000)), Cloud(surface(2000, 1)), align="shift", gsd_m=0.1)
    console = Console(width=160, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(format_table(result))
        text = console.export_text()
    for words in ("Chamfer, mean squared, both ways", "F-score at 0.5 m", "2 x GSD", "shift x, y, z", "voxels 0.1 m"):
        assert words in text


def test_real_cloud_against_itself_half_by_half(shared_data) -> None:
    cloud = read_cloud(shared_data("brighton_beach") / "reference_odm" / "model.laz")
    result = evaluate(cloud[::2], cloud[1::2])
    assert result["fscore"]["0.5"] > 0.98
    assert result["epsg"] == 32615
    assert result["accuracy_median_m"] < 0.15
