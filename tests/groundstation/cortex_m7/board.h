#include <stdint.h>

/* Prints a text and a number. */
void say(const char *text, int32_t number);
/* The program; what it returns is QEMU's exit status. */
int run(void);
