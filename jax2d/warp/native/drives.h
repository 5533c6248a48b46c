// Motors that hold still (brakes) or move to a position (servos). They exert no more than other motors, and reach no
// higher speed; what they add is how they aim.
//
// The mass they aim with is that of the two bodies held by their joint, not of the axis alone: an arm hung up beside its
// centre would take hundreds of passes to follow. What the joint answers is added at once, so that limits, which come
// next, see the speed that stays.

struct Drive {
  real mass;          // kg m^2, of a slider kg: moved along the axis by one unit of impulse, the joint held
  real position;      // rad or m, that a servo moves to
  real max_speed;     // rad/s or m/s, of a servo
  real deceleration;  // rad/s^2 or m/s^2, with which it comes to rest

  KFN static Drive of(const Joint& joint, real inverse_mass, real control, real speed, real h) {
    real mass = Math::inverse_or_zero(inverse_mass);
    real middle = real(0.5) * (joint.lower + joint.upper), reach = real(0.5) * (joint.upper - joint.lower);
    real strength = joint.max_motor_impulse * inverse_mass / h;
    return {mass, middle + (speed < real(0) ? -control : control) * reach, Math::abs(speed),
            SERVO_BRAKING_SHARE * strength};
  }

  // Speed to have for the next h seconds: the largest from which, losing deceleration x h in each, it stands still where
  // it is to be. At the end that is the whole way within h.
  KFN real speed_towards(real way, real inverse_h) const {
    real distance = Math::abs(way), lost = real(0.5) * deceleration / inverse_h;
    real braking = sqrtf(lost * lost + real(2) * deceleration * distance) - lost;
    real speed = Math::min(max_speed, Math::min(braking, distance * inverse_h));
    return way < real(0) ? -speed : speed;
  }
};
