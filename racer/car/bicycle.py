"""The car's motion: a kinematic bicycle whose steering and speed follow their commands with a lag, integrated on the device.

The rear axle's centre moves where the car points, with speed v; the heading turns by v tan(steering) / wheelbase. Steering and speed
come closer to what is asked as exp(-t / lag).
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

WHEELBASE = wp.constant(0.164)
"""Of DeepRacer's car, 1:18 [m]."""


@wp.struct
class CarMotion:
    """A car in motion.

    Attributes:
        x: Of the rear axle's centre [m].
        y: Of the rear axle's centre [m].
        heading: [rad], counter-clockwise from the x axis.
        speed: [m/s].
        steering: Of the front wheels [rad], to the left greater than 0.
    """

    x: float
    y: float
    heading: float
    speed: float
    steering: float


@wp.func
def remaining(seconds: float, lag: float) -> float:
    """Share of the difference between command and value that is left after a time."""
    left = float(0.0)
    if lag > 0.0:
        left = wp.exp(-seconds / lag)
    return left


@wp.func
def turning(speed: float, steering: float, grip: float) -> float:
    """Rate of turn of the heading [rad/s]; tyres bear a lateral acceleration of at most ``grip`` [m/s²]; 0: no limit."""
    found = speed * wp.tan(steering) / WHEELBASE
    if grip > 0.0:
        most = grip / wp.max(wp.abs(speed), 1.0e-3)
        found = wp.clamp(found, -most, most)
    return found


@wp.func
def drive(
    motion: CarMotion,
    speed: float,
    steering: float,
    grip: float,
    speed_lag: float,
    steering_lag: float,
    seconds: float,
    parts: int,
) -> CarMotion:
    """The car after some time.

    Steering and speed are exact. Heading and position are integrated by Simpson's rule in each of equal parts, where the heading in the
    middle is that of the parabola through the three turning velocities.

    Args:
        motion: As it is.
        speed: What is asked [m/s].
        steering: What is asked [rad].
        grip: Greatest lateral acceleration [m/s²]; 0: any.
        speed_lag: Time constant; 0: none [s].
        steering_lag: Time constant; 0: none [s].
        seconds: How long.
        parts: Into how many parts that is divided.
    """
    part = seconds / float(parts)
    half_speed, half_steering = remaining(0.5 * part, speed_lag), remaining(0.5 * part, steering_lag)
    if speed_lag <= 0.0:
        motion.speed = speed
    if steering_lag <= 0.0:
        motion.steering = steering
    for _ in range(parts):
        first_speed = motion.speed
        middle_speed = speed + (first_speed - speed) * half_speed
        last_speed = speed + (middle_speed - speed) * half_speed
        middle_steering = steering + (motion.steering - steering) * half_steering
        last_steering = steering + (middle_steering - steering) * half_steering
        first_turning = turning(first_speed, motion.steering, grip)
        middle_turning = turning(middle_speed, middle_steering, grip)
        last_turning = turning(last_speed, last_steering, grip)
        first = motion.heading
        sixth = part / 6.0
        middle = first + part / 24.0 * (5.0 * first_turning + 8.0 * middle_turning - last_turning)
        last = first + sixth * (first_turning + 4.0 * middle_turning + last_turning)
        motion.x += sixth * (
            first_speed * wp.cos(first) + 4.0 * middle_speed * wp.cos(middle) + last_speed * wp.cos(last)
        )
        motion.y += sixth * (
            first_speed * wp.sin(first) + 4.0 * middle_speed * wp.sin(middle) + last_speed * wp.sin(last)
        )
        motion.heading = last
        motion.speed = last_speed
        motion.steering = last_steering
    return motion
