"""Report: tables, figures and the page, made from the results of a benchmark."""

from marlbc_mj.report.bundle import write_report
from marlbc_mj.results.summary import Result

__all__ = ["Result", "write_report"]
