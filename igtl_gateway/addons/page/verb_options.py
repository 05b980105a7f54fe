"""The options of ``igtl-gateway page``."""

from __future__ import annotations

from igtl_gateway.addon.settings import Setting, address

OPTIONS = (
    Setting("address", "", "address of the page", metavar="[HOST:]PORT", reads=address, shown="127.0.0.1, a free port"),
    Setting(
        "allow", (), "networks whose browsers may connect, or any", metavar="NETWORK", words=True, needs=("address",)
    ),
    Setting("tls_cert", "", "serve with TLS: our certificate (PEM)", metavar="FILE"),
    Setting("tls_key", "", "its key", metavar="FILE", shown="in the file of the certificate", needs=("tls_cert",)),
)
