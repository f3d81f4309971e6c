"""The rasterizer is differentiable: fits 400 Gaussians to a picture and prints the error as it falls."""

import torch

import perception

torch.manual_seed(0)
size, count = 64, 400
y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
target = torch.stack([x / size, y / size, ((x // 16 + y // 16) % 2).float()], dim=-1)  # [H, W, 3]

viewmats = torch.eye(4)[None]  # camera_from_world
Ks = torch.tensor([[[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]])
means = torch.rand(count, 3) * torch.tensor([1.0, 1.0, 0.2]) + torch.tensor([-0.5, -0.5, 1.0])
parameters = {
    "means": means,
    "quats": torch.randn(count, 4),  # wxyz, any norm
    "log_scales": torch.full((count, 3), -3.5),
    "opacity_logits": torch.zeros(count),
    "colors": torch.rand(count, 3),
}
for tensor in parameters.values():
    tensor.requires_grad_()
optimiser = torch.optim.Adam(parameters.values(), lr=0.02)

for step in range(101):
    image = perception.rasterize(
        parameters["means"],
        parameters["quats"],
        parameters["log_scales"].exp(),
        parameters["opacity_logits"].sigmoid(),
        parameters["colors"],
        viewmats,
        Ks,
        size,
        size,
    ).colors[0]
    loss = (image - target).abs().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if step % 20 == 0:
        print(f"step {step:3d}: mean error {loss.item():.3f}")
