
/* ---------------------------------------------------------------- measurements, each for itself */

/* Check whether all joint angles are one number, though those of the default pose are not. */
static bool are_unmeasured(const float *q)
{
    bool equal = true, equal_by_default = true;
    for (int j = 1; j < CREF_JOINTS; j++) {
        equal &= q[j] == q[0];
        equal_by_default &= cref_joints[j].default_pose == cref_joints[0].default_pose;
    }
    return equal && !equal_by_default;
}

/* Keep joint angles if they are within their ranges and something measures them. */
static bool keep_pose(cref_policy *p, const float *q)
{
    const float margin = (float)POSE_MARGIN;
    for (int j = 0; j < CREF_JOINTS; j++) {
        if (!(q[j] > cref_joints[j].low - margin && q[j] < cref_joints[j].high + margin)) {
            p->has_before = false;
            memset(p->turned, 0, sizeof p->turned);
            memset(p->moved, 0, sizeof p->moved);
            return false;
        }
    }
    if (are_unmeasured(q))
        return false;
    memcpy(p->q, q, sizeof p->q);
    if (!p->has_first)
        memcpy(p->first_q, q, sizeof p->first_q);
    p->has_first = true;
    return true;
}

/* Check whether each measurement is possible. */
static unsigned check_each(const float *angular_velocity, const float *gravity, const float *qd)
{
    const float length =
        sqrtf(gravity[0] * gravity[0] + gravity[1] * gravity[1] + gravity[2] * gravity[2]);
    if (!(length > GRAVITY_LENGTH_LOW && length < GRAVITY_LENGTH_HIGH))
        return CREF_BAD_INPUT;
    if (gravity[2] > (float)UPRIGHT * length)
        return CREF_GRAVITY_TURNED;
    unsigned status = CREF_OK;
    if (find_largest(angular_velocity, 3) > (float)MOST_TURNING)
        status |= CREF_GYRO_TOO_FAST;
    if (find_largest(qd, CREF_JOINTS) > (float)MOST_JOINT_SPEED)
        status |= CREF_JOINTS_TOO_FAST;
    return status;
}

/* Compute how gravity turned and joints moved since the step before. */
static void add_changes(cref_policy *p, const float *gravity, const float *q)
{
    if (p->has_before) {
        for (int i = 0; i < 3; i++)
            p->turned[i] = (double)gravity[i] - p->before_gravity[i];
        for (int j = 0; j < CREF_JOINTS; j++)
            p->moved[j] = (double)q[j] - p->before_q[j];
    }
    memcpy(p->before_gravity, gravity, sizeof p->before_gravity);
    memcpy(p->before_q, q, sizeof p->before_q);
    p->has_before = true;
}

/* Check all measurements, and keep them if they can be used; what is too fast is derived. */
static unsigned take_senses(cref_policy *p, const float *angular_velocity, const float *gravity,
                            const float *command, const float *q, const float *qd)
{
    if (are_finite(q, CREF_JOINTS) && !keep_pose(p, q))
        return CREF_BAD_INPUT;
    if (!are_finite(angular_velocity, 3) || !are_finite(gravity, 3) || !are_finite(command, 3) ||
        !are_finite(q, CREF_JOINTS) || !are_finite(qd, CREF_JOINTS))
        return CREF_BAD_INPUT;
    const unsigned status = check_each(angular_velocity, gravity, qd);
    if (status & CREF_FAULTS)
        return status;
    add_changes(p, gravity, q);
    memcpy(p->angular_velocity, angular_velocity, sizeof p->angular_velocity);
    memcpy(p->gravity, gravity, sizeof p->gravity);
    memcpy(p->command, command, sizeof p->command);
    memcpy(p->qd, qd, sizeof p->qd);
    if (status & CREF_GYRO_TOO_FAST) { /* of an upright robot whose gravity turns so */
        p->angular_velocity[0] = (float)(-p->turned[1] / CREF_PERIOD);
        p->angular_velocity[1] = (float)(p->turned[0] / CREF_PERIOD);
        p->angular_velocity[2] = 0.0f;
    }
    if (status & CREF_JOINTS_TOO_FAST)
        for (int j = 0; j < CREF_JOINTS; j++)
            p->qd[j] = (float)(p->moved[j] / CREF_PERIOD);
    return status;
}

#if CREF_LEGS
/* Turn v by an angle, rad, about a unit axis. */
static void rotate(double v[3], const double axis[3], double angle)
{
    const double sine = sin(angle), rest = 1.0 - cos(angle);
    const double once[3] = {axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2],
                            axis[0] * v[1] - axis[1] * v[0]};
    const double twice[3] = {axis[1] * once[2] - axis[2] * once[1],
                             axis[2] * once[0] - axis[0] * once[2],
                             axis[0] * once[1] - axis[1] * once[0]};
    for (int i = 0; i < 3; i++)
        v[i] += sine * once[i] + rest * twice[i];
}

/* Compute the soles' directions less that of gravity, in the base's frame. */
static void tilt_feet(const cref_policy *p, double tilts[CREF_LEGS][3])
{
    const double x = p->gravity[0], y = p->gravity[1], z = p->gravity[2];
    const double length = sqrt(x * x + y * y + z * z);
    for (int leg = 0; leg < CREF_LEGS; leg++) {
        double down[3] = {0.0, 0.0, -1.0};
        for (int k = CREF_LEG_JOINTS - 1; k >= 0; k--)
            rotate(down, leg_axes[leg][k], p->q[leg_joints[leg][k]]);
        for (int i = 0; i < 3; i++)
            tilts[leg][i] = down[i] - p->gravity[i] / length;
    }
}

/* Compute the largest difference of two tilts. */
static double compare_tilts(const double a[3], const double b[3])
{
    double largest = 0.0;
    for (int i = 0; i < 3; i++)
        largest = fmax(largest, fabs(a[i] - b[i]));
    return largest;
}

/* Check whether the feet are level, by gravity and joint angles. */
static bool stands(const cref_policy *p)
{
    double tilts[CREF_LEGS][3];
    tilt_feet(p, tilts);
    for (int leg = 0; leg < CREF_LEGS; leg++)
        for (int i = 0; i < 3; i++)
            if (!(fabs(tilts[leg][i]) < MOST_FOOT_TILT)) /* NaN before the first measurement */
                return false;
    return true;
}

/* Check whether gravity has moved as the legs of a robot that stands on both feet say. */
static bool leans_as_legs_say(cref_policy *p)
{
    if (p->tilt_count == CREF_TILTS)
        memmove(p->tilts[0], p->tilts[1], (CREF_TILTS - 1) * sizeof p->tilts[0]);
    else
        p->tilt_count++;
    tilt_feet(p, p->tilts[p->tilt_count - 1]);
    if (p->tilt_count < CREF_TILTS)
        return true;
    const int half = CREF_TILTS / 2;
    double early[CREF_LEGS][3] = {{0.0}}, late[CREF_LEGS][3] = {{0.0}}, apart = 0.0, change = 0.0;
    for (int leg = 0; leg < CREF_LEGS; leg++) {
        for (int k = 0; k < half; k++) {
            for (int i = 0; i < 3; i++) {
                early[leg][i] += p->tilts[k][leg][i] / half;
                late[leg][i] += p->tilts[half + k][leg][i] / half;
            }
        }
        apart = fmax(apart, compare_tilts(late[leg], late[0]));
        change = fmax(change, compare_tilts(late[leg], early[leg]));
    }
    const float sag = compare_poses(p->q, p->first_q);
    const bool both_stand = sag < (float)MOST_SAG && apart < MOST_APART;
    return !both_stand || change < MOST_CHANGE;
}
#else
static bool stands(const cref_policy *p)
{
    (void)p; /* the manifest does not describe the legs */
    return true;
}

static bool leans_as_legs_say(cref_policy *p)
{
    (void)p;
    return true;
}
#endif
