"""The shortest way in: a digging environment, ten random actions."""

import gymnasium as gym

import mpm_env  # noqa: F401  registers the environments


def main(task: str = "mpm_env/DigSand-v0", fidelity: str = "draft", actions: int = 10) -> dict[str, float]:
    """Take random actions; returns the return and the largest force on the bucket in N."""
    env = gym.make(task, fidelity=fidelity)
    env.action_space.seed(0)
    env.reset(seed=0)
    total, force = 0.0, 0.0
    for _ in range(actions):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += float(reward)
        force = max(force, float((info["force_N"] ** 2).sum() ** 0.5))
        if terminated or truncated:
            env.reset()
    env.close()
    return {"return": total, "force_peak_N": force}


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name}: {value:.2f}")
