"""Transforms of motion: each a pytree with `forward` and `inverse`, each method in a file of its own."""

from .base import AbstractTransform as AbstractTransform
from .base import Chain as Chain
from .dct import Dct as Dct
from .dct import dct_matrix as dct_matrix
from .lsdt import Lsdt as Lsdt
from .lsdt import LsdtFit as LsdtFit
from .lsdt import constant as constant
from .lsdt import fit_lsdt as fit_lsdt
from .lsdt import growing as growing
from .pca import Pca as Pca
from .pca import fit_pca as fit_pca
from .wavelet import Cdf97 as Cdf97
from .wavelet import Haar as Haar
from .wavelet import haar_matrix as haar_matrix
