"""Recording: MCAP logs, and videos rendered from them."""

from marlbc_mj.util.matplotlib_folder import prepare_matplotlib

prepare_matplotlib()
