// A timing box on an ATmega328P at 16 MHz. The protocol is described in PROTOCOL.md, beside this file.
//
// Ten outputs: pins D2 to D7 (port D) and D9 to D12 (port B); bit n of a mask is pin Dn, 1 is on.
// D8 is the start input, D13 the gate: high from the first edge of a program to its end.
// Timer 1 counts ticks of 0.5 us. Interrupts only wake the processor: an edge itself is made by a
// loop that nothing can interrupt.

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stdint.h>
#include <string.h>
#include <util/crc16.h>

#define PROTOCOL 1
#define SLOTS 8
#define EDGES 24

#define OUTPUTS_D 0xFC
#define OUTPUTS_B 0x1E
#define OUTPUTS ((OUTPUTS_B << 8) | OUTPUTS_D)
#define RECEIVE _BV(PD0)  // pulled up: an open line sends nothing
#define START _BV(PB0)    // pulled up: an open input never rises
#define GATE _BV(PB5)

#define SHORTEST 10  // ticks between two edges: the loop below needs 8
#define FIRST 40     // ticks from the start to the first edge
#define NEAR 32      // ticks before an edge from which nothing is listened to

#define LINE 96
#define RING 64
#define MAGIC 0x4C53

typedef struct {
  uint32_t ticks;  // since the edge before
  uint16_t mask;
} edge_t;

typedef struct {
  uint16_t magic, polarity, serial, crc;
} kept_t;

static kept_t EEMEM kept_in_eeprom;
static uint16_t EEMEM boots_in_eeprom;

static edge_t edges[SLOTS][EDGES];
static uint8_t n_edges[SLOTS];
static kept_t kept;
static uint16_t boots, runs, held, limit;
static uint8_t cause, armed;  // armed: number of the slot + 1

static volatile char ring[RING];
static volatile uint8_t head, tail, stop, started;
static volatile uint16_t started_at, age;

static char line[LINE + 1];
static uint8_t length;
static char *rest;
static uint16_t crc;

// ---- interrupts: all that they do is to keep what came, and to wake the processor ----

ISR(USART_RX_vect) {
  char c = UDR0;
  uint8_t next = (head + 1) % RING;
  age = 0;
  if (c == '!') {
    stop = 1;
  } else if (next != tail) {
    ring[head] = c;
    head = next;
  }
}

ISR(TIMER1_OVF_vect) { age++; }

ISR(TIMER1_CAPT_vect) {
  started_at = ICR1;
  started = 1;
}

EMPTY_INTERRUPT(TIMER1_COMPB_vect)

// Sleep until an interrupt. Interrupts are off before and after; none that comes in between is missed.
static void nap(void) {
  sleep_enable();
  sei();
  sleep_cpu();
  sleep_disable();
  cli();
}

// ---- outputs ----

static void show(uint16_t mask) {
  uint16_t levels = (mask ^ kept.polarity) & OUTPUTS;
  held = mask;
  PORTB = (levels >> 8) | START;
  PORTD = levels | RECEIVE;
}

// Wait for a tick less than 2^15 away; 0 if the host said stop. Interrupts are off afterwards.
static uint8_t until(uint16_t tick) {
  OCR1B = tick;
  TIFR1 = _BV(OCF1B);
  TIMSK1 |= _BV(OCIE1B);
  cli();
  wdt_reset();
  while (!stop && (int16_t)(TCNT1 - tick) < 0) {
    nap();
    wdt_reset();
  }
  return !stop;
}

// Play a program whose start was at a tick; 0 if it was stopped. Interrupts are off afterwards.
static uint8_t play(const edge_t *edge, uint8_t n, uint16_t due) {
  for (uint8_t i = 0; i < n; i++, edge++) {
    uint32_t left = i ? edge->ticks : FIRST;
    uint16_t levels = edge->mask ^ kept.polarity;
    uint8_t b = (levels >> 8) | START | GATE, d = levels | RECEIVE;
    while (left > 0x7FFF) {
      due += 0x4000;
      left -= 0x4000;
      if (!until(due)) return 0;
    }
    due += left;
    if ((uint16_t)left > NEAR && !until(due - NEAR)) return 0;
    OCR1A = due;
    TIFR1 = _BV(OCF1A);
    asm volatile(
        "1: sbis %[flags], %[match]\n"  // 3 cycles each time round: an edge is at most 2 late
        "   rjmp 1b\n"
        "   out %[portb], %[b]\n"
        "   out %[portd], %[d]\n"  // 1 cycle after port B
        ::[flags] "I"(_SFR_IO_ADDR(TIFR1)), [match] "I"(OCF1A), [portb] "I"(_SFR_IO_ADDR(PORTB)),
        [portd] "I"(_SFR_IO_ADDR(PORTD)), [b] "r"(b), [d] "r"(d));
    held = edge->mask;
  }
  return 1;
}

// ---- sending ----

static void send(char c) {
  while (!(UCSR0A & _BV(UDRE0))) continue;
  UDR0 = c;
  crc = _crc_xmodem_update(crc, c);
}

static void say(const char *text) {
  while (*text) send(*text++);
}

static void say_hex(uint32_t number, uint8_t n_digits) {
  while (n_digits--) {
    uint8_t digit = (number >> (4 * n_digits)) & 15;
    send(digit < 10 ? '0' + digit : 'a' + digit - 10);
  }
}

static void say_number(uint32_t number, uint8_t n_digits) {
  send(' ');
  say_hex(number, n_digits);
}

static void begin(const char *text) {
  crc = 0xFFFF;
  say(text);
}

static void end(void) {
  uint16_t sum = crc;
  send('*');
  say_hex(sum, 4);
  send('\n');
}

static void reply(const char *text) {
  char tag[] = {line[0], ' ', 0};
  begin(tag);
  say(text);
}

static void refuse(const char *reason) {
  reply("no ");
  say(reason);
  end();
}

static void accept(void) {
  reply("ok");
  end();
}

// ---- what stops everything ----

static void forget(void) {
  armed = 0;
  show(0);
}

static void halt(void) {
  forget();
  cli();
  stop = 0;
  tail = head;
  sei();
  length = 0;
  begin("!off");
  say_number(boots, 4);
  end();
}

// ---- commands ----

// Read the next number of the line; 0 if there is none, or if it is larger than allowed.
static uint8_t number(uint32_t *value, uint32_t most) {
  uint8_t n = 0;
  *value = 0;
  if (*rest++ != ' ') return 0;
  for (;; rest++, n++) {
    char c = *rest | 0x20;
    uint8_t digit = c >= '0' && c <= '9' && *rest >= '0' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : 16;
    if (digit > 15) break;
    if (n == 8) return 0;
    *value = *value << 4 | digit;
  }
  return n && *value <= most && (*rest == ' ' || !*rest);
}

static uint8_t at_end(void) { return !*rest; }

static uint8_t mask_given(uint32_t *value) { return number(value, OUTPUTS) && !(*value & ~(uint32_t)OUTPUTS); }

static uint16_t kept_crc(void) {
  uint16_t sum = 0xFFFF;
  for (const uint8_t *p = (const uint8_t *)&kept; p < (const uint8_t *)&kept.crc; p++)
    sum = _crc_xmodem_update(sum, *p);
  return sum;
}

static void keep(void) {
  kept.crc = kept_crc();
  eeprom_update_block(&kept, &kept_in_eeprom, sizeof kept);
}

static void identify(void) {
  reply("ok labseq-ttl");
  say_number(PROTOCOL, 2);
  say_number(kept.serial, 4);
  say_number(boots, 4);
  say_number(cause, 2);
  end();
}

static void tell_state(void) {
  reply(armed ? "ok armed" : "ok idle");
  say_number(boots, 4);
  say_number(runs, 4);
  say_number(held, 4);
  say_number(kept.polarity, 4);
  end();
}

static void set_polarity(void) {
  uint32_t mask;
  if (!mask_given(&mask) || !at_end()) return refuse("arguments");
  kept.polarity = mask;
  show(held);
  keep();
  accept();
}

static void set_serial(void) {
  uint32_t serial;
  if (!number(&serial, 0xFFFF) || !at_end()) return refuse("arguments");
  kept.serial = serial;
  keep();
  accept();
}

static void set_lines(void) {
  uint32_t mask;
  if (!mask_given(&mask) || !at_end()) return refuse("arguments");
  show(mask);
  accept();
}

static void set_limit(void) {
  uint32_t ms;
  if (!number(&ms, 0xFFFF) || !at_end()) return refuse("arguments");
  limit = (ms * 125 + 4095) / 4096;  // overflows of 32.768 ms
  accept();
}

static void put(void) {
  uint32_t slot, first, ticks, mask;
  if (!number(&slot, SLOTS - 1) || !number(&first, EDGES - 1)) return refuse("arguments");
  if (first > n_edges[slot]) return refuse("gap");
  if (armed == slot + 1) armed = 0;
  n_edges[slot] = first;
  do {
    if (!number(&ticks, 0xFFFFFFFF) || !mask_given(&mask)) return refuse("arguments");
    if (first == EDGES) return refuse("full");
    if (first ? ticks < SHORTEST : ticks != 0) return refuse("short");
    edges[slot][first].ticks = ticks;
    edges[slot][first].mask = mask;
    n_edges[slot] = ++first;
  } while (!at_end());
  reply("ok");
  say_number(first, 2);
  end();
}

static void get(void) {
  uint32_t slot, i;
  if (!number(&slot, SLOTS - 1) || !number(&i, EDGES - 1) || !at_end()) return refuse("arguments");
  if (i >= n_edges[slot]) return refuse("gap");
  reply("ok");
  say_number(edges[slot][i].ticks, 8);
  say_number(edges[slot][i].mask, 4);
  end();
}

static void arm(void) {
  uint32_t slot, n;
  if (!number(&slot, SLOTS - 1) || !number(&n, EDGES) || !at_end()) return refuse("arguments");
  if (!n || n != n_edges[slot]) return refuse("gap");
  armed = slot + 1;
  reply("ok");
  say_number(boots, 4);
  end();
}

static void run(uint8_t external) {
  if (!at_end()) return refuse("arguments");
  if (!armed) return refuse("unarmed");
  uint8_t slot = armed - 1, finished = 0;
  started = 0;
  TIFR1 = _BV(ICF1);
  accept();
  armed = 0;
  cli();
  if (external) {
    TIMSK1 |= _BV(ICIE1);
    while (!started && !stop) {
      wdt_reset();
      nap();
    }
    TIMSK1 &= ~_BV(ICIE1);
  } else {
    started_at = TCNT1;
  }
  if (!stop) finished = play(edges[slot], n_edges[slot], started_at);
  PORTB &= ~GATE;
  TIMSK1 &= ~_BV(OCIE1B);
  tail = head;
  age = 0;
  sei();
  if (!finished) return;  // halt() says so
  runs++;
  begin("!done");
  say_number(boots, 4);
  say_number(runs, 4);
  end();
}

static void fire(void) { run(0); }

static void fire_at_start(void) { run(1); }

static void all_off(void) {
  forget();
  accept();
}

static const struct {
  const char *name;
  void (*obey)(void);
} commands[] = {
    {"id", identify},   {"state", tell_state}, {"polarity", set_polarity}, {"serial", set_serial},
    {"set", set_lines}, {"timeout", set_limit}, {"put", put},              {"get", get},
    {"arm", arm},       {"fire", fire},         {"await", fire_at_start},  {"off", all_off},
};

// Whether the line ends in its own checksum, which is then cut off.
static uint8_t undamaged(void) {
  uint32_t sum;
  if (length < 6 || length > LINE || line[length - 5] != '*') return 0;
  line[length] = 0;
  line[length - 5] = ' ';
  rest = line + length - 5;
  if (!number(&sum, 0xFFFF)) return 0;
  length -= 5;
  line[length] = 0;
  crc = 0xFFFF;
  for (uint8_t i = 0; i < length; i++) crc = _crc_xmodem_update(crc, line[i]);
  return crc == sum && line[1] == ' ';
}

static void answer(void) {
  if (!undamaged()) {
    line[0] = '?';
    return refuse("damaged");
  }
  for (uint8_t i = 0; i < sizeof commands / sizeof *commands; i++) {
    uint8_t n = strlen(commands[i].name);
    if (strncmp(line + 2, commands[i].name, n) || (line[2 + n] && line[2 + n] != ' ')) continue;
    rest = line + 2 + n;
    return commands[i].obey();
  }
  refuse("unknown");
}

static void take(char c) {
  if (c == '\n') {
    if (length) answer();
    length = 0;
  } else if (c != '\r' && length <= LINE) {
    line[length++] = c;
  }
}

// ---- life ----

static void begin_life(void) {
  cause = MCUSR;
  MCUSR = 0;
  wdt_enable(WDTO_250MS);
  eeprom_read_block(&kept, &kept_in_eeprom, sizeof kept);
  if (kept.magic != MAGIC || kept.crc != kept_crc()) kept = (kept_t){.magic = MAGIC};
  show(0);
  DDRD = OUTPUTS_D;
  DDRB = OUTPUTS_B | GATE;
  boots = eeprom_read_word(&boots_in_eeprom) + 1;
  eeprom_update_word(&boots_in_eeprom, boots);
  UCSR0A = _BV(U2X0);
  UBRR0 = 3;  // 500 kbaud, exactly
  UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
  UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
  TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS11);  // rising edges, with noise canceller; 16 MHz / 8
  TIMSK1 = _BV(TOIE1);
  set_sleep_mode(SLEEP_MODE_IDLE);
  sei();
  begin("!boot");
  say_number(boots, 4);
  say_number(cause, 2);
  end();
}

static void look_at_age(void) {
  cli();
  uint8_t old = limit && age >= limit;
  if (old) age = 0;
  sei();
  if (!old || !(held || armed)) return;
  forget();
  begin("!alone");
  say_number(boots, 4);
  end();
}

int main(void) {
  begin_life();
  for (;;) {
    wdt_reset();
    look_at_age();
    if (stop) {
      halt();
    } else if (head != tail) {
      char c = ring[tail];
      tail = (tail + 1) % RING;
      take(c);
    } else {
      cli();
      if (head == tail && !stop) nap();
      sei();
    }
  }
}
