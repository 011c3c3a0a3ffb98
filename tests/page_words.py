"""Words of each page of docs/, as `wc -w` counts them: ./dev python -m tests.page_words."""

from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
PAGE_MAX = 4_500
"""Words of the longest page; the rig protocol had 10 800."""
TOTAL_MAX = 27_000
"""Words of all pages; they had 46 800 before they were halved."""


def page_words() -> dict[str, int]:
    """Number of words of each page, the shortest first."""
    counts = {
        str(page.relative_to(DOCS)): len(page.read_text("utf-8").split())
        for page in DOCS.rglob("*.md")
    }
    return dict(sorted(counts.items(), key=lambda item: item[1]))


def main() -> None:
    """Prints them."""
    counts = page_words()
    for page, words in counts.items():
        print(f"{words:6}  {page}")
    print(f"{sum(counts.values()):6}  in all; limits: {TOTAL_MAX}, of a page {PAGE_MAX}")


if __name__ == "__main__":
    main()
