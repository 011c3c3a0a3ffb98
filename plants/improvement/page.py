"""Report page of an improved model: predicted and measured costs, last diagnosis, tuning."""

from estune.run.results import report as tuning_report
from estune.support.html_page import Page, Paragraph, Section, Table, Warnings
from plants.diagnosis.report import page as diagnosis_page
from plants.improvement.result import COLUMNS, Improvement
from plants.remedies.text import full_sentence


def page(improvement: Improvement) -> Page:
    """The page of an improvement: its costs, then the pages of its parts as sections."""
    diagnosis = diagnosis_page.page(improvement.diagnosis)
    rounds = [
        (", ".join(round_.experiments) or "all records anew", round_.diagnosis.heading())
        for round_ in improvement.rounds
    ]
    costs = [
        Table(COLUMNS, improvement.rows(), numeric=(1, 2, 3)),
        Paragraph(full_sentence(improvement.conclusion)),
    ]
    sections = [
        Section("Diagnoses", (Table(("Experiments", "Verdict of all records so far"), rounds),)),
        *_chapter("The last diagnosis", diagnosis),
    ]
    if improvement.tuning is not None:
        sections += _chapter("Tuning on the rig", tuning_report.page(improvement.tuning))
    return Page(
        f"Model of {improvement.rig.name}",
        diagnosis.headline,
        (
            Paragraph(f"{improvement.heading()}.", "lead"),
            *(costs if improvement.costs else ()),
            Warnings(improvement.remarks),
        ),
        sections,
    )


def _chapter(title: str, page: Page) -> list[Section]:
    return [Section(title, (page.headline, *page.summary)), *page.sections]
