"""Reports: the tables, figures and pages made from the results of a benchmark."""

from marlbc_mj.util.matplotlib_folder import prepare_matplotlib

prepare_matplotlib()
