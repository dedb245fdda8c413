"""What ``stress`` and ``certify`` say of the float network beside the chip."""

from pathlib import Path

from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.requests.check import CertifyRequest, StressRequest
from spikeloom.runtime.studies.robustness.results import ComparedProvenance


def compared(
    request: CertifyRequest | StressRequest, data_sha256: str, loaded: LoadedNetwork
) -> ComparedProvenance:
    """Provenance of a request on recordings with this hash, and of its network."""
    return ComparedProvenance.of(
        request,
        data_sha256,
        checkpoint=Path(str(request.checkpoint)).name,
        checkpoint_sha256=loaded.sha256,
        graph=loaded.graph,
        **loaded.read_as,
    )
