"""Pictures by number of training views: a row per number, one test view, all methods."""

import numpy as np
from PIL import Image

from econgs_bench.reports.family import Family
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.sections.section import Page
from econgs_bench.reports.sections.views import section as training_views
from tests.reports.page.test_page import content, undrawn


def trained(maker, numbers=(92, 6, 12)):
    for number in numbers:
        for method, psnr in (("econgs", 30.0), ("ivr-gs", 28.0)):
            maker.run(scene="shock", method=method, requested_views=number, psnr=psnr + number / 50, views=3)
    return maker


def test_a_grid_has_a_row_per_number_of_views_and_a_column_per_method(maker):
    ((name, panels),) = training_views.grids(trained(maker).tables(), maker.root)
    assert name == "vortex / shock"
    assert [panel.title for panel in panels] == [f"{n} training views" for n in (6, 12, 92)]
    assert len({panel.view for panel in panels}) == 1
    for panel, number in zip(panels, (6, 12, 92), strict=True):
        assert [shot.row["method"] for shot in panel.shots] == ["econgs", "ivr-gs"]
        assert {shot.row["requested_views"] for shot in panel.shots} == {number}
        for shot in panel.shots:
            file = maker.root / f"jobs/{shot.row['job']}/renders/{panel.view}.png"
            assert shot.picture.shape == (*Image.open(file).size, 3)
            assert not np.array_equal(shot.picture, panel.truth)
            assert shot.cost == "3.81 MiB, 120 FPS"


def test_one_number_of_views_has_no_grid(maker, tmp_path):
    report = trained(maker, numbers=(42,)).report()
    assert training_views.section(Page(report, Family(), root=maker.root, folder=tmp_path)) is None


def test_the_page_has_the_grids_and_a_file_of_each(maker, tmp_path):
    tables = trained(maker, numbers=(6, 92)).tables()
    with undrawn() as panels:
        source, _ = content(write_report(tables, maker.root, tmp_path / "report.html"))
    assert source.count('id="views"') == 1
    file = ("vortex / shock by training views", tmp_path / "charts")
    assert file in [call.args[1:] for call in panels.call_args_list]
