"""The constitutive models, by name. A new one is a file beside these and a line in MATERIALS."""

from mpm_env.mpm.materials.elastic import Elastic
from mpm_env.mpm.materials.protocol import Material
from mpm_env.mpm.materials.sand import Sand
from mpm_env.mpm.materials.snow import Snow

MATERIALS: dict[str, type] = {"elastic": Elastic, "sand": Sand, "snow": Snow}

__all__ = ["MATERIALS", "Elastic", "Material", "Sand", "Snow"]
