"""The constitutive models, by name. A new one is a file beside these and a line in MATERIALS."""

from mpm_env.mpm.materials.cam_clay import CamClay
from mpm_env.mpm.materials.elastic import Elastic
from mpm_env.mpm.materials.herschel_bulkley import HerschelBulkley
from mpm_env.mpm.materials.mu_i import MuI
from mpm_env.mpm.materials.protocol import Material
from mpm_env.mpm.materials.sand import Sand
from mpm_env.mpm.materials.snow import Snow
from mpm_env.mpm.materials.von_mises import VonMises

MATERIALS: dict[str, type] = {
    "elastic": Elastic,
    "sand": Sand,
    "snow": Snow,
    "von_mises": VonMises,
    "herschel_bulkley": HerschelBulkley,
    "mu_i": MuI,
    "cam_clay": CamClay,
}

__all__ = ["MATERIALS", "CamClay", "Elastic", "HerschelBulkley", "Material", "MuI", "Sand", "Snow", "VonMises"]
