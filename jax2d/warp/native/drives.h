// Motors that hold still (brakes) or move to a position (servos). They exert no more than other motors, and reach no
// higher speed; what they add is how they aim.

struct Drive {
  real position;      // rad or m, that a servo moves to
  real max_speed;     // rad/s or m/s, of a servo

  KFN static Drive of(const Joint& joint, real control, real speed) {
    real middle = real(0.5) * (joint.lower + joint.upper), reach = real(0.5) * (joint.upper - joint.lower);
    return {middle + (speed < real(0) ? -control : control) * reach, Math::abs(speed)};
  }

  // Speed to have for the next h seconds, where the motor can change it by `most` in that time: the largest from which,
  // losing a share of that in each, it stands still where it is to be. At the end that is the whole way within h.
  KFN real speed_towards(real way, real most, real inverse_h) const {
    real deceleration = SERVO_BRAKING_SHARE * most * inverse_h;
    real distance = Math::abs(way), lost = real(0.5) * deceleration / inverse_h;
    real braking = sqrtf(lost * lost + real(2) * deceleration * distance) - lost;
    real speed = Math::min(max_speed, Math::min(braking, distance * inverse_h));
    return way < real(0) ? -speed : speed;
  }
};
