"""Pick a bottle with the digital twin; `Robot.connect()` does the same with a running HAL."""

from z1_runtime import Robot


def main() -> bool:
    """Return whether the jaws hold the bottle."""
    with Robot.simulate("bottle", seed=0) as robot:
        result = robot.pick("bottle")
    print(f"held: {result.held}, jaw angle {result.jaw:.2f} rad, rejections {result.rejections}")
    return result.held


if __name__ == "__main__":
    raise SystemExit(0 if main() else 1)
