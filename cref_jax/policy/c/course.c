
/* ---------------------------------------------------------------- from the start to damping */

/* Check the time of a step, and the age of the newest frame and of the command. */
static unsigned check_time(cref_policy *p, double now, double commanded)
{
    if (!isfinite(now) || !isfinite(commanded))
        return CREF_BAD_INPUT;
    unsigned status = CREF_OK;
    const double passed = p->has_step_time ? now - p->step_time : 0.0;
    p->step_time = now;
    p->has_step_time = true;
    if (!(passed >= 0.0 && passed <= LATE * CREF_PERIOD))
        status |= CREF_LATE;
    if (fabs(now - commanded) > STOP_AFTER)
        status |= CREF_STALE_COMMAND | CREF_STOPPED;
#if CREF_SEES
    const bool old = !p->encoded || fabs(now - p->stamp) > CREF_STALE + 1e-6; /* rounding */
    p->unseen_steps = old ? p->unseen_steps + 1 : 0; /* in steps: the clock may be wrong */
    if (p->unseen_steps * CREF_PERIOD > STOP_AFTER)
        status |= CREF_STOPPED;
    if (!p->encoded)
        status |= CREF_NO_DEPTH;
    else if (old)
        status |= CREF_STALE_DEPTH;
#endif
    return status;
}

/* Begin when all has been right on level feet for long enough, or return why not. */
static unsigned begin(cref_policy *p, unsigned status)
{
    const unsigned unseen = CREF_NO_DEPTH | CREF_STALE_DEPTH;
    unsigned wrong = status & (CREF_GYRO_TOO_FAST | CREF_JOINTS_TOO_FAST | unseen);
    const bool level = p->good_steps > 0 || stands(p);
    if (!level || !leans_as_legs_say(p))
        wrong |= CREF_NOT_ON_FEET;
    p->good_steps = wrong ? 0 : p->good_steps + 1;
    if (wrong & ~unseen)
        p->wait = fmax(START_AGAIN, CREF_START_AFTER);
    p->begun = p->good_steps > 0 && p->good_steps * CREF_PERIOD > p->wait - 1e-6;
    float way = 0.0f;
    for (int j = 0; j < CREF_JOINTS; j++)
        way = fmaxf(way, fabsf(cref_joints[j].default_pose - p->q[j]));
    if (p->begun && way > FAR) {
        p->ramp_steps = (int)(way / (START_SPEED * CREF_PERIOD));
        memcpy(p->ramp_from, p->q, sizeof p->q);
    }
    return wrong;
}

/* Gather and normalise the observation. */
static void observe(const cref_policy *p, const float command[3], float obs[CREF_OBSERVATION])
{
    float *part = obs;
    memcpy(part, p->angular_velocity, sizeof p->angular_velocity);
    memcpy(part + 3, p->gravity, sizeof p->gravity);
    memcpy(part + 6, command, 3 * sizeof *command);
    part += 9;
    for (int j = 0; j < CREF_JOINTS; j++) {
        part[j] = p->q[j] - cref_joints[j].default_pose;
        part[CREF_JOINTS + j] = p->qd[j];
        part[2 * CREF_JOINTS + j] = p->action[j];
    }
    for (int i = 0; i < CREF_OBSERVATION; i++) {
        const float x = (obs[i] - observation_mean[i]) / observation_std[i];
        obs[i] = clip(x, -OBSERVATION_CLIP, OBSERVATION_CLIP);
    }
}

/* Convert the action to the target, within the limits. */
static unsigned aim(cref_policy *p)
{
    unsigned status = CREF_OK;
    for (int j = 0; j < CREF_JOINTS; j++) {
        const struct cref_joint *joint = &cref_joints[j];
        const float wanted = joint->default_pose + joint->action_scale * p->action[j];
        const float low = joint->low - joint->beyond, high = joint->high + joint->beyond;
        float target = clip(wanted, low, high);
        if (target != wanted)
            status |= CREF_RANGE_LIMITED;
        if (p->aimed) {
            const float least = p->target[j] - joint->rate, most = p->target[j] + joint->rate;
            const float moved = clip(target, least, most);
            if (moved != target)
                status |= CREF_RATE_LIMITED;
            target = moved;
        }
        p->target[j] = target;
    }
    p->aimed = true;
    return status;
}

/* Go on to the default pose, or run the network and set the target if the action is finite. */
static unsigned act(cref_policy *p, bool standing)
{
    if (p->ramp_step < p->ramp_steps) {
        const float share = (float)((double)++p->ramp_step / p->ramp_steps);
        for (int j = 0; j < CREF_JOINTS; j++)
            p->target[j] =
                p->ramp_from[j] + (cref_joints[j].default_pose - p->ramp_from[j]) * share;
        return CREF_STARTING;
    }
    unsigned status = CREF_OK;
    float command[3], obs[CREF_OBSERVATION], action[CREF_JOINTS];
    for (int i = 0; i < 3; i++) {
        command[i] = clip(p->command[i], command_low[i], command_high[i]);
        if (command[i] != p->command[i])
            status |= CREF_COMMAND_LIMITED;
        if (standing)
            command[i] = 0.0f;
    }
    observe(p, command, obs);
    run_network(p, obs, action);
    if (!are_finite(action, CREF_JOINTS)) {
        if (!p->aimed) /* there is no good target to hold */
            memcpy(p->target, p->q, sizeof p->target);
        return status | CREF_BAD_ACTION;
    }
    for (int j = 0; j < CREF_JOINTS; j++)
        p->action[j] = clip(action[j], -ACTION_CLIP, ACTION_CLIP);
    return status | aim(p);
}

/* Choose the target to return: the network's, the last one, or a pose. */
static unsigned choose(cref_policy *p, unsigned status, float target[CREF_JOINTS])
{
    p->faulty_steps = status & CREF_FAULTS ? p->faulty_steps + 1 : 0;
    p->damping |= p->begun && p->faulty_steps > CREF_HOLD_STEPS;
    const float *chosen = p->target;
    if (!p->begun) {
        if (status & CREF_FAULTS) {
            p->good_steps = 0;
            p->wait = fmax(START_AGAIN, CREF_START_AFTER);
        }
        if (!p->good_steps && status & ~(unsigned)CREF_NO_DEPTH)
            status |= CREF_NOT_STARTED;
        chosen = p->first_q;
    } else if (p->damping) {
        status |= CREF_DAMPING;
        chosen = p->q;
    } else if (p->faulty_steps) {
        status |= CREF_HOLDING;
    }
    memcpy(target, chosen, sizeof p->target);
#if CREF_SEES
    status |= p->frame_status;
#endif
    return status;
}

unsigned cref_step(cref_policy *p, const float angular_velocity[3], const float gravity[3],
                   const float command[3], const float q[CREF_JOINTS], const float qd[CREF_JOINTS],
                   double now, double commanded, float target[CREF_JOINTS])
{
    unsigned status = check_time(p, now, commanded);
    status |= take_senses(p, angular_velocity, gravity, command, q, qd);
    if (!p->begun && !(status & CREF_FAULTS))
        status |= begin(p, status);
    if (p->told_to_stop)
        status |= CREF_STOPPED;
    if (p->begun && !(status & CREF_FAULTS))
        status |= act(p, status & CREF_STOPPED);
    return choose(p, status, target);
}

void cref_reset(cref_policy *p)
{
    memset(p, 0, sizeof *p);
    for (int j = 0; j < CREF_JOINTS; j++)
        p->q[j] = p->first_q[j] = p->target[j] = cref_joints[j].default_pose;
    p->wait = CREF_START_AFTER;
}

void cref_stop(cref_policy *p)
{
    p->told_to_stop = true;
}

void cref_begin_at_once(cref_policy *p)
{
    p->begun = true;
}

bool cref_on_both_feet(const cref_policy *p)
{
    return stands(p) && find_largest(p->qd, CREF_JOINTS) < (float)STILL;
}
