/* Starts main on a Cortex-M of QEMU, and ends QEMU with what it returns. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

extern uint32_t stack, stored, data_begin, data_end, bss_begin, bss_end;
extern void initialise_monitor_handles(void);
int main(void);
void _init(void) {}
void _fini(void) {}

void reset(void) {
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the floating-point unit */
    __asm volatile("dsb\n isb");
    memcpy(&data_begin, &stored, (size_t)((char *)&data_end - (char *)&data_begin));
    memset(&bss_begin, 0, (size_t)((char *)&bss_end - (char *)&bss_begin));
    initialise_monitor_handles();
    exit(main());
}
static void fault(void) { exit(99); }

__attribute__((section(".vectors"), used)) static void *const vectors[] = {
    &stack, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault};
