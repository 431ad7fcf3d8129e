import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from econgs_bench.reports.__main__ import main
from econgs_bench.reports.files import write_files, write_text
from econgs_bench.reports.inputs import NEEDED, Unusable, read_results
from econgs_bench.reports.schema import COLUMNS, TABLES, frame
from econgs_bench.reports.sections.paper import documents as paper_documents
from econgs_bench.reports.sections.paper import tables as papers
from econgs_bench.reports.sections.paper.values import NOT_MEASURED
from econgs_bench.reports.tables.documents import to_csv, to_latex
from econgs_bench.reports.tables.ranks import UNDECIDED_NOTE
from econgs_bench.reports.tables.table import tex
from tests.reports.conftest import fill
from tests.reports.page.test_page import content
from tests.reports.sections.paper.test_paper_tables import four, paper_tables, results, row, seen, waves


def written(maker):
    report = maker.report()
    write_files(report, maker.root / "out", papers.paper_tables(report.stored, report.views))
    return maker.root / "out"


def test_a_file_that_cannot_be_written_leaves_the_old_one_alone(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    write_text(path, "old")

    def full(self, content):
        path.with_name(self.name).open("wb").write(content[:1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        write_text(path, "new")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"report.html": "old"}


def test_curves_are_laid_out_as_compressai_does(maker):
    for rate, psnr, size in ((64, 33.0, 3000), (4, 31.0, 1000)):
        for scene in "ab":
            maker.run(scene=scene, method="ivr-gs", rate=rate, psnr=psnr, size=size, fps=10.0, views=0)
    maker.run(scene="a", method="hac/x y", views=0)
    curve = json.loads((written(maker) / "curves" / "vortex" / "iVR-GS.json").read_text())
    assert set(curve) == {"name", "description", "results"}
    assert curve["name"] == "iVR-GS"
    results = curve["results"]
    assert (results["rate"], results["bytes"], results["psnr"]) == (["4", "64"], [1000, 3000], [31.0, 33.0])
    assert results["fps"] == [10.0, 10.0]
    assert "lpips_vgg" not in results
    assert {len(values) for values in results.values()} == {2}
    assert [p.name for p in (maker.root / "out" / "curves" / "vortex").iterdir()] == ["iVR-GS.json"]


def test_parquet_and_csv_hold_the_same(maker):
    fill(maker, "failures")
    out = written(maker)
    results = maker.tables()["results"]
    stored = pd.read_parquet(out / "results.parquet")
    pd.testing.assert_frame_equal(stored.astype(results.dtypes), results)
    back = pd.read_csv(out / "results.csv", keep_default_na=False)
    assert list(back.columns) == list(results.columns)
    assert back["psnr"].tolist() == [str(value) if value else "" for value in results["psnr"].fillna(0)]


def test_intervals_and_comparisons_are_files(maker):
    maker.run(method="a", psnr=30.0)
    maker.run(method="b", psnr=32.0)
    out = written(maker)
    intervals = pd.read_csv(out / "intervals.csv").set_index(["method", "metric"])
    # The maker's views lie 2 dB around the mean of the row.
    assert intervals.loc[("a", "psnr"), "mean"] == pytest.approx(30.0)
    assert intervals.loc[("a", "psnr"), "views"] == 5
    pair = pd.read_csv(out / "comparisons.csv").query("metric == 'psnr'").iloc[0]
    assert (pair["first"], pair["second"], pair["difference"], pair["apart"]) == ("a", "b", -2.0, True)


def test_bd_rates_are_a_file(maker):
    for rate, psnr, size in ((1, 30.0, 100), (2, 32.0, 200), (3, 34.0, 400), (4, 36.0, 800)):
        maker.run(method="a", rate=rate, psnr=psnr, size=size)
        maker.run(method="b", rate=rate, psnr=psnr, size=size // 2)
    row = pd.read_csv(written(maker) / "bd-rate.csv").iloc[0]
    assert row["rate"] == pytest.approx(-50.0)
    assert row["psnr_range"] == "30 to 36"
    # The maker's views of all methods differ alike, so nothing of their spread is left in the difference.
    assert [float(end) for end in row["rate_interval"].split(" to ")] == pytest.approx(
        [-50.0, -50.0], abs=0.01
    )


# --------------------------------------------------------------------------- LaTeX


def check_latex(text, folder):
    """By pdflatex where there is one, and by structure: environments and braces close, rows have as many
    cells as columns, no sign of LaTeX's own is bare, and nothing needs another engine."""
    code = re.sub(r"(?<!\\)%.*", "", text)
    bare = re.sub(r"\\[{}&%$#_]", "", code)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert not re.search(r"[#_~]", bare)
    assert not re.search(r"\^", re.sub(r"\$[^$]*\$", "", bare))
    assert text.isascii(), sorted({sign for sign in text if not sign.isascii()})
    assert re.findall(r"\\begin\{(\w+)\}", code) == re.findall(r"\\end\{(\w+)\}", code)
    kind, spec = re.search(r"\\begin\{(\w+)\}\{([lr]+)\}", code).groups()
    body, after = bare.split(rf"\end{{{kind}}}")
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    for line in rows:
        spans = sum(int(count) - 1 for count in re.findall(r"\\multicolumn\{(\d+)\}", line))
        assert line.count("&") + 1 + spans == len(spec), line
    assert "&" not in after
    assert code.index(r"\toprule") < code.index(r"\midrule") < code.index(rf"\end{{{kind}}}")
    assert code.count(r"\toprule") == code.count(r"\bottomrule") == 1
    if shutil.which("pdflatex"):
        head = r"\documentclass{article}\usepackage{booktabs,longtable}\begin{document}\tiny "
        (folder / "t.tex").write_text(head + text + r"\end{document}", encoding="utf-8")
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"]
        done = subprocess.run(command, cwd=folder, capture_output=True, encoding="utf-8", check=False)
        assert done.returncode == 0, done.stdout[-2000:]
    return kind, after


@pytest.mark.parametrize("case", ["many", "failures", "signs"])
def test_latex_compiles(maker, case):
    if case == "signs":
        maker.run(scene="a_b & c%", method="m#1$", psnr=30.0)
        maker.run(scene="a_b & c%", method="~{x}^", psnr=31.0)
    else:
        fill(maker, case)
    report = maker.report()
    results = report.results
    kind, after = check_latex(to_latex(results, report.ranks, "A remark."), maker.root)
    assert kind == "longtable", "it breaks across pages"
    assert "A remark." in after
    for reason in results.loc[results["status"] != "ok", "reason"]:
        assert tex(str(reason)) in to_latex(results), "why a row failed is printed"


@pytest.mark.parametrize("size", [0.1, 3.0])
def test_the_papers_tables_compile(size, tmp_path):
    rows = [*four("econgs", 35.1), *four("3dgs", 35.0), *four("ivr-gs", 34.0)]
    rows += [*four("econgs", 35.0, seed=1)[:3], row(scene="TF04", status="oom", psnr=None, seed=1)]
    rows += [one | {"variant": "view_direction=true", "job": f"v{i}"} for i, one in enumerate(rows[:4])]
    rows += [one | {"preset": "quick", "requested_views": 42, "job": f"q{i}"} for i, one in enumerate(rows)]
    table = results(*rows)
    by_name = {one.name: one for one in paper_tables(table, seen(table, waves(size)))}
    assert {"univariate", "design"} <= set(by_name)
    for one in by_name.values():
        kind, after = check_latex(paper_documents.to_latex(one), tmp_path)
        assert kind == "tabular"
        unmeasured = any(line.note == NOT_MEASURED for block in one.blocks for line in block.rows)
        assert ("with -- only" in after) == unmeasured
    _, after = check_latex(paper_documents.to_latex(by_name["univariate"]), tmp_path)
    assert (UNDECIDED_NOTE.partition("%")[2] in after) == (size > 1), "a note explains a printed sign"
    assert "seed 1: TF04 oom" in after


# --------------------------------------------------------------------------- tables of other tools


def csv(tmp_path, text, name="results.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


SMALL = "dataset,scene,method,psnr,size_bytes\nd,a,x,30.5,1000\nd,b,x,31.5,2000\nd,a,y,33,4000\nd,b,y,,\n"


def test_a_table_with_the_least_columns_makes_a_report(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["--table", str(csv(tmp_path, SMALL)), "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out / "report.html")
    source, text = content(out / "report.html")
    assert "31.00" in text  # the mean of x
    assert "no psnr" in source
    # Nothing that the table lacks has a column, a fact or a section.
    for words in ("Preset", "Machine", "Image size", "LPIPS", "SSIM", "FLIP", "ΔE", "Primitives", "Load",
                  "Host mem", "Reference kernel"):  # fmt: skip
        assert words not in text, words
    assert not {"scenes", "editing", "provenance"} & set(re.findall(r'<h2 id="(\w+)"', source))
    heads = (out / "results.md").read_text(encoding="utf-8").splitlines()[0]
    assert heads == "| Dataset | Scene | Method | PSNR [dB] | Size [MiB] | Status | Reason |"
    assert (out / "charts" / "psnr-size.pdf").stat().st_size
    assert "**33.00**" in (out / "results.md").read_text(encoding="utf-8")
    curve = json.loads((out / "curves" / "d" / "x.json").read_text())
    assert curve["results"] == {"rate": [""], "bytes": [1500.0], "psnr": [31.0]}


def test_a_file_where_the_folder_shall_be_is_an_error(tmp_path, capsys):
    table = csv(tmp_path, SMALL)
    assert main(["--table", str(table), "--out", str(table)]) == 2
    assert main(["--table", str(table), "--out", str(table / "deeper")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all(line.startswith(f"error: {table}") and "--out" in line for line in lines)


def test_reports_needs_no_other_package_of_this_project(tmp_path):
    """In a process where they cannot be imported."""
    code = (
        "import sys\n"
        "for name in ('bench', 'methods', 'econgs', 'datasets', 'torch'): sys.modules[name] = None\n"
        "from econgs_bench.reports.__main__ import main\n"
        f"sys.exit(main(['--table', {str(csv(tmp_path, SMALL))!r}, '--out', {str(tmp_path / 'out')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stderr


def test_further_columns_are_used(tmp_path):
    text = "psnr,method,scene,dataset,size_bytes,fps,rate,seed,note\n30,x,a,d,10,5.5,64,2,hello\n"
    row = read_results(csv(tmp_path, text))["results"].iloc[0]
    assert (row["fps"], row["rate"], row["seed"], row["status"]) == (5.5, 64.0, 2, "ok")


def test_parquet_is_read(tmp_path):
    table = pd.DataFrame(
        {"dataset": ["d"], "scene": ["a"], "method": ["x"], "psnr": [30.0], "size_bytes": [7]}
    )
    table.to_parquet(tmp_path / "r.parquet")
    assert read_results(tmp_path / "r.parquet")["results"]["size_bytes"].tolist() == [7]


EXAMPLES = {"string": 'text, with "quotes"', "boolean": True, "Float64": 0.1 + 0.2, "Int64": 2**40 + 1}
COMPUTED = {"job", "stale", "omissions", "differences"}
"""Columns that a report makes itself."""


@pytest.mark.parametrize("filled", [True, False])
def test_every_column_comes_back_as_it_was_written(tmp_path, filled):
    """As `bench results` writes them: with a value, and empty where it may be."""
    given = {"fitted_scenes": '["a", "b"]', "kind": "basic", "status": "ok", "psnr": 30.125, "split": "test"}
    given |= dict.fromkeys(("contents", "metric_versions", "options"), '{"a": "b, c"}')
    examples = {name: EXAMPLES[COLUMNS[name].dtype] for name in TABLES["results"].columns}
    rows = [{**examples, **given}, {**examples, **given, "scene": "b", "procedural": False}]
    if not filled:
        rows = [{name: row[name] for name in NEEDED} for row in rows]
    table = frame("results", rows)
    (tmp_path / "r.csv").write_text(to_csv(table), encoding="utf-8")
    back = read_results(tmp_path / "r.csv")["results"]
    for name in sorted(set(table.columns) - COMPUTED):
        if filled or name in NEEDED:
            assert back[name].dtype == COLUMNS[name].dtype
            pd.testing.assert_series_equal(back[name], table[name], check_exact=True, check_dtype=False)


@pytest.mark.parametrize(("cell", "value"), [("true", True), ("FALSE", False), ("1", True), ("0", False)])
def test_truths_of_other_tools_are_read(tmp_path, cell, value):
    text = f"dataset,scene,method,psnr,size_bytes,procedural\nd,a,x,30,10,{cell}\n"
    assert read_results(csv(tmp_path, text))["results"]["procedural"].tolist() == [value]


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("dataset,scene,method,psnr,size_bytes,procedural\nd,a,x,30,1,maybe\n", ["line 2", "true nor false"]),
        ("dataset,scene,method,psnr,size_bytes,fitted_scenes\nd,a,x,30,1,[\n", ["line 2", "JSON list"]),
        ("", ["header"]),
        ("dataset,scene,method,psnr,size_bytes\n", ["rows"]),
        ("dataset,scene,method,PSNR,size\n", ["psnr, size_bytes", "psnr -> psnr, size -> size_bytes"]),
        ("a,b\n1,2\n", ["dataset, scene, method, psnr, size_bytes"]),
        (SMALL.replace("30.5", "30,5"), ["line 2", "6", "5"]),
        (SMALL.replace("psnr,size", "psnr,psnr,size"), ["psnr"]),
        (SMALL.replace("30.5", "high"), ["line 2", "psnr = high"]),
        (SMALL.replace("30.5", "inf"), ["line 2", "psnr = inf"]),
        (SMALL.replace("1000", "1000.5"), ["line 2", "size_bytes = 1000.5"]),
        (SMALL.replace("d,b,x", ",b,x"), ["line 3", "dataset"]),
        (SMALL.replace("d,b,x", "d,a,x"), ["line 3", "d / a / x"]),
    ],
)
def test_unusable_tables_are_refused_with_file_reason_and_remedy(tmp_path, capsys, text, facts):
    path = csv(tmp_path, text)
    assert main(["--table", str(path), "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: {path}: ")
    assert message.removeprefix(f"error: {path}: ").partition("; ")[2], "a remedy"
    assert all(fact in message for fact in facts), message
    assert not (tmp_path / "out").exists()


def test_files_that_are_no_tables(tmp_path):
    with pytest.raises(Unusable, match="no such file"):
        read_results(tmp_path / "none.csv")
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00\x01binary")
    with pytest.raises(Unusable, match="cannot be read as a table"):
        read_results(tmp_path / "x.csv")
    (tmp_path / "x.parquet").write_bytes(b"no")
    with pytest.raises(Unusable, match="cannot be read as a table"):
        read_results(tmp_path / "x.parquet")
