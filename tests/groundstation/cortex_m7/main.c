/* Self-test of a correction, and how many instructions one evaluation takes: QEMU is told to count one nanosecond an
   instruction, and the board's timer counts nanoseconds at 25 MHz, so that a tick is 40 instructions. */
#include <stdint.h>

#include "board.h"
#include "correction.h"

#define TIMER ((volatile uint32_t *)0x40000000u)
#define ROUNDS 1000

static volatile float sink;

static uint32_t ticks(int evaluate)
{
    static volatile float given[CORRECTION_FEATURES];
    float features[CORRECTION_FEATURES], delta[3];
    given[CORRECTION_COS_PHI] = given[CORRECTION_COS_THETA] = 1.0F;
    given[CORRECTION_Z] = 1.0F;
    given[CORRECTION_U_BATT] = 15.0F;
    given[CORRECTION_T] = CORRECTION_MASS * 9.81F;
    given[CORRECTION_VX] = 1.0F;
    TIMER[1] = 0xFFFFFFFFu;
    TIMER[0] = 1;
    const uint32_t before = TIMER[1];
    for (int i = 0; i < ROUNDS; ++i) {
        for (int k = 0; k < CORRECTION_FEATURES; ++k)
            features[k] = given[k];
        if (evaluate)
            correction(features, delta);
        else
            delta[0] = features[0];
        sink = delta[0];
    }
    return before - TIMER[1];
}

int run(void)
{
    const int failed = correction_self_test();
    const uint32_t nothing = ticks(0), all = ticks(1);
    say("self_test ", failed);
    say("instructions ", (int32_t)((all - nothing) * 40u / ROUNDS));
    return failed != -1;
}
