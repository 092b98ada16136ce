// The timing box without a box: runs the firmware on simavr's ATmega328P, with its serial line on a pty.
//
// runner FIRMWARE.hex
//   standard output, line by line:
//     pty NAME        the serial port, once, when the firmware listens to it
//     CYCLE LEVELS    the output registers (port B << 8 | port D, hex) from that clock cycle on
//     reset CYCLE     the processor was reset: its outputs are inputs now
//     start CYCLE     the start input rose
//     line CYCLE      the end of a line was received
//   standard input, line by line; its end ends the process:
//     reset           press the reset button
//     reset CYCLES    the same, so many cycles after the gate next rises
//     start           a rising edge at the start input, which is pulled up
//     start CYCLES    the same, so many cycles after the gate next rises
//     low             it goes low
//     skip CYCLES     let time pass
//     hang            overwrite the firmware where it is with an endless loop, until the next reset
//
// While the gate is high, or bytes move, time passes as fast as it can, else as fast as outside.

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_hex.h>

#define FREQUENCY 16000000
#define CYCLES_PER_BYTE 400   // 10 bits at 500 kbaud are 320, but simavr receives no faster than 12
#define BUSY_CYCLES 160000    // 10 ms: what a line may take to be answered
#define LOOK_INSTRUCTIONS 20000
#define GATE 0x2000
#define RJMP_SELF 0xCFFF

static avr_t *avr;
static avr_irq_t *serial_in, *start_pin;
static int line_fd, kept_fd;
static char name[64];
static uint16_t levels;
static avr_cycle_count_t busy_until, reset_after, reset_at, start_after;
static avr_cycle_count_t rise(struct avr_t *box, avr_cycle_count_t when, void *unused);
static uint8_t inbox[4096];
static size_t n_in, at_in;
static uint32_t hung_at;
static uint8_t healthy[2];

static void quiet(avr_t *box, const int level, const char *format, va_list values) {
  (void)box, (void)level, (void)format, (void)values;
}

static void stay_busy(avr_cycle_count_t cycles) {
  if (avr->cycle + cycles > busy_until) busy_until = avr->cycle + cycles;
}

// Lets no sleep go past a time.
static avr_cycle_count_t wake(struct avr_t *box, avr_cycle_count_t when, void *unused) {
  (void)box, (void)when, (void)unused;
  return 0;
}

static void on_levels(struct avr_irq_t *irq, uint32_t value, void *shift) {
  (void)irq;
  uint16_t before = levels;
  int by = (int)(intptr_t)shift;
  levels = (levels & ~(0xFF << by)) | (value & 0xFF) << by;
  if (levels == before) return;
  printf("%llu %04x\n", (unsigned long long)avr->cycle, levels);
  if (reset_after && levels & ~before & GATE) {
    reset_at = avr->cycle + reset_after;
    avr_cycle_timer_register(avr, reset_after, wake, NULL);
    reset_after = 0;
  }
  if (start_after && levels & ~before & GATE) {
    avr_cycle_timer_register(avr, start_after, rise, NULL);
    start_after = 0;
  }
  if (!(levels & GATE)) stay_busy(BUSY_CYCLES);
}

static void on_sent(struct avr_irq_t *irq, uint32_t value, void *unused) {
  (void)irq, (void)unused;
  uint8_t byte = value;
  stay_busy(BUSY_CYCLES);
  if (*name) printf("pty %s\n", name);  // it listens now
  *name = 0;
  if (byte == '\n') fflush(stdout);  // who has the answer can read what came before it
  if (write(line_fd, &byte, 1) < 0 && errno != EAGAIN) exit(0);
}

// One byte after the other, at the speed of the line.
static avr_cycle_count_t deliver(struct avr_t *box, avr_cycle_count_t when, void *unused) {
  (void)when, (void)unused;
  if (at_in == n_in) {
    at_in = n_in = 0;
    return 0;
  }
  if (inbox[at_in] == '\n') printf("line %llu\n", (unsigned long long)box->cycle);
  avr_raise_irq(serial_in, inbox[at_in++]);
  stay_busy(BUSY_CYCLES);
  return box->cycle + CYCLES_PER_BYTE;
}

// Driven from outside, and so stronger than the pull-up.
static void set_start(uint8_t level) {
  avr_ioport_external_t driven = {.name = 'B', .mask = 1, .value = level};
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('B'), &driven);
  avr_raise_irq(start_pin, level);
}

static avr_cycle_count_t rise(struct avr_t *box, avr_cycle_count_t when, void *unused) {
  (void)when, (void)unused;
  printf("start %llu\n", (unsigned long long)box->cycle);
  set_start(0);
  set_start(1);
  return 0;
}

// simavr polls idle interrupt pins in every cycle, unless it is told not to, after each reset.
static void poll_less(void) {
  for (uint8_t i = 0; i < 2; i++) avr_extint_set_strict_lvl_trig(avr, i, 0);
}

static void tell_reset(void) {
  poll_less();
  if (hung_at) memcpy(avr->flash + hung_at, healthy, 2);
  hung_at = 0;
  levels = 0;
  avr_raise_irq(start_pin, 0);  // simavr forgets the level in a reset, but not that it has told it
  set_start(1);
  printf("reset %llu\n", (unsigned long long)avr->cycle);
  stay_busy(BUSY_CYCLES);
}

static void reset(void) {
  reset_at = 0;
  at_in = n_in = 0;
  avr_reset(avr);
  avr_regbit_set(avr, avr->reset_flags.extrf);
  tell_reset();
}

static void obey(const char *command) {
  unsigned long long cycles = 0;
  if (sscanf(command, "skip %llu", &cycles) == 1) {
    stay_busy(cycles);
  } else if (sscanf(command, "reset %llu", &cycles) == 1) {
    reset_after = cycles;
  } else if (!strncmp(command, "reset", 5)) {
    reset();
  } else if (sscanf(command, "start %llu", &cycles) == 1) {
    start_after = cycles;
  } else if (!strncmp(command, "start", 5)) {
    avr_cycle_timer_register(avr, CYCLES_PER_BYTE, rise, NULL);
    stay_busy(BUSY_CYCLES);
  } else if (!strncmp(command, "low", 3)) {
    set_start(0);
  } else if (!strncmp(command, "hang", 4)) {
    hung_at = avr->pc;
    memcpy(healthy, avr->flash + hung_at, 2);
    avr->flash[hung_at] = RJMP_SELF & 0xFF;
    avr->flash[hung_at + 1] = RJMP_SELF >> 8;
    stay_busy(FREQUENCY);
  }
}

static void listen_for(int timeout_ms) {
  static char command[64];
  static size_t n_command;
  struct pollfd files[] = {{.fd = STDIN_FILENO, .events = POLLIN}, {.fd = line_fd, .events = POLLIN}};
  fflush(stdout);
  if (poll(files, n_in ? 1 : 2, timeout_ms) <= 0) return;
  if (files[0].revents) {
    char bytes[64];
    ssize_t n = read(STDIN_FILENO, bytes, sizeof bytes);
    if (n < 1) exit(0);
    for (ssize_t i = 0; i < n; i++) {  // all of them: what comes on the line after a command finds it obeyed
      if (bytes[i] != '\n' && n_command < sizeof command - 1) {
        command[n_command++] = bytes[i];
      } else {
        command[n_command] = 0;
        n_command = 0;
        obey(command);
      }
    }
  }
  if (!n_in && files[1].revents & POLLIN) {
    ssize_t n = read(line_fd, inbox, sizeof inbox);
    if (n > 0) {
      n_in = n;
      avr_cycle_timer_register(avr, CYCLES_PER_BYTE, deliver, NULL);
      stay_busy(BUSY_CYCLES);
    }
  }
}

static int is_busy(void) { return levels & GATE || avr->cycle < busy_until; }

// The processor sleeps until its next interrupt: so many cycles.
static void on_sleep(avr_t *box, avr_cycle_count_t cycles) {
  (void)box;
  listen_for(is_busy() ? 0 : (int)(cycles * 1000 / FREQUENCY));
}

static int open_line(void) {
  struct termios raw;
  cfmakeraw(memset(&raw, 0, sizeof raw));
  raw.c_cflag = CS8 | CREAD | CLOCAL | B500000;
  if (openpty(&line_fd, &kept_fd, name, &raw, NULL) < 0) return -1;
  return fcntl(line_fd, F_SETFL, O_NONBLOCK);
}

static int make_box(const char *firmware) {
  uint32_t size, start, flags = 0;
  uint8_t *code = read_ihex_file(firmware, &size, &start);
  avr = avr_make_mcu_by_name("atmega328p");
  if (!code || !avr) return -1;
  avr_global_logger_set(quiet);
  avr_init(avr);
  avr->frequency = FREQUENCY;
  avr->sleep = on_sleep;
  avr_loadcode(avr, code, size, start);
  avr->codeend = avr->flashend;
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  poll_less();
  serial_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  start_pin = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 0);
  set_start(1);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, NULL);
  for (char port = 'B'; port <= 'D'; port += 2) {
    avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), IOPORT_IRQ_REG_PORT);
    avr_irq_register_notify(irq, on_levels, (void *)(intptr_t)(port == 'B' ? 8 : 0));
  }
  stay_busy(BUSY_CYCLES);
  return 0;
}

int main(int n, char **words) {
  if (n != 2 || make_box(words[1]) || open_line()) {
    fprintf(stderr, "expected: runner FIRMWARE.hex\n");
    return 1;
  }
  for (unsigned count = 0;; count++) {
    int state = avr_run(avr);
    if (state == cpu_Done || state == cpu_Crashed) {
      fprintf(stderr, "the firmware crashed at %04x\n", (unsigned)avr->pc);
      return 1;
    }
    if (reset_at && avr->cycle >= reset_at) reset();
    if (hung_at && avr_regbit_get(avr, avr->reset_flags.wdrf)) tell_reset();
    if (count % LOOK_INSTRUCTIONS == 0) listen_for(0);
  }
}
