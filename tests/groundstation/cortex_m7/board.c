/* QEMU's mps2-an500 (Cortex-M7) without an operating system: the start, and semihosting, by which a program speaks. */
#include <stdint.h>

#include "board.h"

extern uint32_t stack_top, data_stored, data_start, data_end, bss_start, bss_end;

static uint32_t semihosting(uint32_t operation, uint32_t argument)
{
    register uint32_t r0 __asm("r0") = operation;
    register uint32_t r1 __asm("r1") = argument;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void say(const char *text, int32_t number)
{
    char digits[12];
    int at = sizeof digits - 1;
    uint32_t left = number < 0 ? 0u - (uint32_t)number : (uint32_t)number;
    digits[at] = 0;
    do
        digits[--at] = (char)('0' + left % 10u);
    while (left /= 10u);
    if (number < 0)
        digits[--at] = '-';
    semihosting(0x04, (uint32_t)text); /* SYS_WRITE0 */
    semihosting(0x04, (uint32_t)(digits + at));
    semihosting(0x04, (uint32_t) "\n");
}

static void start(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating point unit */
    __asm volatile("dsb\n isb");
    for (uint32_t *word = &data_start, *from = &data_stored; word < &data_end; ++word, ++from)
        *word = *from;
    for (uint32_t *word = &bss_start; word < &bss_end; ++word)
        *word = 0;
    const uint32_t done[2] = {0x20026u, (uint32_t)run()}; /* ADP_Stopped_ApplicationExit */
    semihosting(0x20, (uint32_t)done);                    /* SYS_EXIT_EXTENDED */
    for (;;) {
    }
}

static void fault(void)
{
    const uint32_t done[2] = {0x20026u, 70u};
    semihosting(0x20, (uint32_t)done);
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &stack_top, start, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault};
