/* Runs a policy in C for the tests: calls come from stdin, answers go to stdout, both binary. */

#include "cref_policy.c"

#include <stdio.h>
#include <stdlib.h>

enum { POLICIES = 2 };
enum call { RESET, ON_DEPTH, STEP, STOP, ON_BOTH_FEET, BEGIN_AT_ONCE, ROUND_TO_HALF, TEXT };

static void take(void *data, size_t size)
{
    if (fread(data, 1, size, stdin) != size)
        exit(3);
}

static void give(const void *data, size_t size)
{
    if (fwrite(data, 1, size, stdout) != size)
        exit(4);
}

static void step(cref_policy *policy)
{
    float angular_velocity[3], gravity[3], command[3], q[CREF_JOINTS], qd[CREF_JOINTS];
    float target[CREF_JOINTS];
    double times[2];
    take(angular_velocity, sizeof angular_velocity);
    take(gravity, sizeof gravity);
    take(command, sizeof command);
    take(q, sizeof q);
    take(qd, sizeof qd);
    take(times, sizeof times);
    const unsigned status =
        cref_step(policy, angular_velocity, gravity, command, q, qd, times[0], times[1], target);
    give(&status, sizeof status);
    give(target, sizeof target);
    give(policy->velocity, sizeof policy->velocity);
}

#if CREF_SEES
static void on_depth(cref_policy *policy)
{
    static float depth[CREF_ROWS * CREF_COLUMNS];
    double stamp;
    take(depth, sizeof depth);
    take(&stamp, sizeof stamp);
    const unsigned status = cref_on_depth(policy, depth, stamp);
    give(&status, sizeof status);
}

static void round_numbers(void)
{
    unsigned count;
    take(&count, sizeof count);
    give(&count, sizeof count);
    for (unsigned i = 0; i < count; i++) {
        float x;
        take(&x, sizeof x);
        x = round_to_half(x);
        give(&x, sizeof x);
    }
}
#endif

static void say(void)
{
    unsigned status;
    take(&status, sizeof status);
    const char *text = cref_status_text(status);
    give(text, strlen(text));
    give("\n", 1);
}

int main(void)
{
    static cref_policy policies[POLICIES];
    unsigned char call, which;
    memset(policies, 0xaa, sizeof policies); /* what the caller's memory may hold before a reset */
    while (fread(&call, 1, 1, stdin) == 1) {
        take(&which, 1);
        cref_policy *policy = &policies[which % POLICIES];
        switch ((enum call)call) {
        case RESET: cref_reset(policy); break;
        case STEP: step(policy); break;
        case STOP: cref_stop(policy); break;
        case BEGIN_AT_ONCE: cref_begin_at_once(policy); break;
        case ON_BOTH_FEET: {
            const bool stands_still = cref_on_both_feet(policy);
            give(&stands_still, 1);
            break;
        }
        case TEXT: say(); break;
#if CREF_SEES
        case ON_DEPTH: on_depth(policy); break;
        case ROUND_TO_HALF: round_numbers(); break;
#else
        default: exit(5);
#endif
        }
    }
    return 0;
}
