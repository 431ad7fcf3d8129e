"""The same with torch, so that its jobs are forked: the fit computes on several threads of every library."""

from fake import Single, _spec

SPEC = _spec("fake-torch", joint=False, implementation="fake_torch:Torch")


class Torch(Single):
    name = "fake-torch"

    def fit(self, *arguments):
        import numpy as np
        import torch
        from scipy.linalg import blas
        from scipy.spatial import cKDTree

        matrix = torch.ones(512, 512, requires_grad=True)
        (matrix @ matrix).exp().sum().backward()
        torch.nn.functional.conv2d(torch.ones(4, 16, 64, 64), torch.ones(16, 16, 3, 3))
        square = np.ones((512, 512))
        assert (square @ square == blas.dgemm(1.0, square, square)).all()
        cKDTree(np.eye(3)).query(np.eye(3), workers=-1)
        return super().fit(*arguments)
