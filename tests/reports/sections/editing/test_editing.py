"""Edited models: the table by edit, and the sequences of pictures."""

import pytest

from econgs_bench.reports.family import Family
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.sections.editing import section as editing
from econgs_bench.reports.sections.section import Page
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.means import summary
from tests.reports.page.test_page import content, undrawn


@pytest.fixture
def edited(maker):
    def run(scene, edit, psnr, **more):
        maker.run(
            scene=f"{scene} {edit}".strip(), kind="edited" if edit else "basic", edit=edit, psnr=psnr, **more
        )

    for scene, base in (("a", 40.0), ("b", 36.0)):
        run(scene, "", base)
        run(scene, "opacity=2", base - 4)
        run(scene, "light=1,0,0", 0.0, status="refused", reason="no light")
        run(scene, "", base + 1, method="econgs")
        run(scene, "opacity=2", base - 2, method="econgs")
        run(scene, "light=1,0,0", base - 1, method="econgs")
    run("c", "", 20.0)  # never edited: in no mean of the section
    return maker


def test_quality_by_edit_is_of_the_edited_scenes_alone(edited) -> None:
    ((name, heads, rows),) = editing.quality(edited.tables()["results"])
    assert name == "vortex"
    assert heads == ["Method", editing.UNEDITED, "opacity=2", "light=1,0,0"]
    assert rows == [["3DGS", "38.00", "34.00", "refused"], ["ECoNGS-R", "39.00", "36.00", "37.00"]]


def test_an_incomplete_mean_is_none(edited) -> None:
    edited.run(scene="d", method="econgs")
    edited.run(scene="d opacity=2", kind="edited", edit="opacity=2", method="econgs")
    ((_, _, rows),) = editing.quality(edited.tables()["results"])
    assert rows[0][2] == MISSING


def test_edits_are_in_no_mean_of_the_dataset(edited) -> None:
    rows = summary(edited.tables()["results"]).set_index("method")
    assert rows.loc["3dgs", "psnr"] == pytest.approx((40 + 36 + 20) / 3)


def test_a_sequence_shows_one_view_of_all_edits(edited) -> None:
    tables = edited.tables()
    (first, second) = editing.sequences(tables, edited.root)
    assert first[0] == "vortex / a"
    assert [panel.caption for panel in first[1]] == [editing.UNEDITED, "opacity=2", "light=1,0,0"]
    assert len({panel.view for panel in first[1]}) == 1
    shots = [[(shot.row["method"], shot.psnr is not None) for shot in panel.shots] for panel in first[1]]
    assert shots == [
        [("3dgs", True), ("econgs", True)],
        [("3dgs", True), ("econgs", True)],
        [("3dgs", False), ("econgs", True)],
    ]
    assert second[0] == "vortex / b"


def test_the_page_has_edits_once(edited, tmp_path) -> None:
    with undrawn() as panels:
        source, _ = content(write_report(edited.tables(), edited.root, tmp_path / "report.html"))
    assert source.count('id="editing"') == 1
    assert "<h3>vortex / a opacity=2" not in source  # not among the scenes as well
    assert ("vortex / a edited", tmp_path / "charts") in [call.args[1:] for call in panels.call_args_list]
    assert "3, 4 edited" in source


def test_without_edits_there_is_no_section(maker, tmp_path) -> None:
    maker.run()
    assert editing.section(Page(maker.report(), Family(), folder=tmp_path)) is None
