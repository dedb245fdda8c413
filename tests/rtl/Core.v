// Cores and an output bus with the ports and memories that the harness knows, written as they are defined: a neuron a
// cycle, queues without limits between places. Nothing is from RANC but the names.
`timescale 1ns / 1ps

module CSRAM #(parameter NUM_NEURONS = 2, parameter WIDTH = 2) ();
    reg [WIDTH-1:0] memory [0:NUM_NEURONS-1];
endmodule

module TokenController #(parameter NUM_AXONS = 2, parameter NUM_WEIGHTS = 4) ();
    reg state = 0;
    reg [$clog2(NUM_WEIGHTS)-1:0] neuron_instructions [0:NUM_AXONS-1];
endmodule

`define PARAMETERS \
    parameter PACKET_WIDTH = 30, parameter NUM_AXONS = 256, parameter NUM_TICKS = 16, parameter DX_MSB = 29, \
    parameter DX_LSB = 21, parameter DY_MSB = 20, parameter DY_LSB = 12, parameter ROUTER_BUFFER_DEPTH = 4
`define MESH_PORTS \
    input clk, input rst, input ren_in_west, input ren_in_east, input ren_in_north, input ren_in_south, \
    input empty_in_west, input empty_in_east, input empty_in_north, input empty_in_south, \
    input [PACKET_WIDTH-1:0] east_in, input [PACKET_WIDTH-1:0] west_in, \
    input [DX_LSB-1:0] north_in, input [DX_LSB-1:0] south_in, \
    output reg ren_out_west = 0, output reg ren_out_east = 0, output reg ren_out_north = 0, \
    output reg ren_out_south = 0, output reg empty_out_west = 1, output reg empty_out_east = 1, \
    output reg empty_out_north = 1, output reg empty_out_south = 1, output reg [PACKET_WIDTH-1:0] east_out, \
    output reg [PACKET_WIDTH-1:0] west_out, output reg [DX_LSB-1:0] north_out, output reg [DX_LSB-1:0] south_out, \
    output token_controller_error, output scheduler_error
// a neighbour asks between two edges and has its packet after the next
`define GIVE(side) if (ren_in_``side && to_``side.size() > 0) side``_out = to_``side.pop_front(); \
    empty_out_``side = to_``side.size() == 0;
`define TAKE(side) if (ren_out_``side) begin route(side``_in); ren_out_``side = 0; end \
    else if (!empty_in_``side) ren_out_``side = 1;
`define EXCHANGE \
    assign token_controller_error = 0, scheduler_error = 0; \
    reg [PACKET_WIDTH-1:0] to_west[$], to_east[$], here[$]; \
    reg [DX_LSB-1:0] to_north[$], to_south[$]; \
    reg [DY_LSB-1:0] scheduler_packet = 0; \
    reg scheduler_wen = 0; \
    task route(input [PACKET_WIDTH-1:0] p); \
        if ($signed(p[DX_MSB:DX_LSB]) > 0) to_east.push_back({p[DX_MSB:DX_LSB] - 1'b1, p[DX_LSB-1:0]}); \
        else if (p[DX_MSB:DX_LSB] != 0) to_west.push_back({p[DX_MSB:DX_LSB] + 1'b1, p[DX_LSB-1:0]}); \
        else if ($signed(p[DY_MSB:DY_LSB]) > 0) to_north.push_back({p[DY_MSB:DY_LSB] - 1'b1, p[DY_LSB-1:0]}); \
        else if (p[DY_MSB:DY_LSB] != 0) to_south.push_back({p[DY_MSB:DY_LSB] + 1'b1, p[DY_LSB-1:0]}); \
        else here.push_back(p); \
    endtask \
    always @(negedge clk) begin \
        `TAKE(west) `TAKE(east) `TAKE(north) `TAKE(south) \
        scheduler_wen = here.size() > 0; \
        if (scheduler_wen) scheduler_packet = here.pop_front(); \
    end \
    always @(posedge clk) begin \
        `GIVE(west) `GIVE(east) `GIVE(north) `GIVE(south) \
    end

module OutputBus #(`PARAMETERS, parameter NUM_OUTPUTS = 256) (
    `MESH_PORTS, output [$clog2(NUM_OUTPUTS)-1:0] packet_out, output packet_out_valid
);
    `EXCHANGE
    assign packet_out = scheduler_packet >> $clog2(NUM_TICKS);
    assign packet_out_valid = scheduler_wen;
endmodule

module Core #(
    `PARAMETERS, parameter NUM_NEURONS = 256, parameter NUM_WEIGHTS = 4, parameter NUM_RESET_MODES = 2,
    parameter POTENTIAL_WIDTH = 9, parameter WEIGHT_WIDTH = 9, parameter LEAK_WIDTH = 9,
    parameter THRESHOLD_WIDTH = 9, parameter CSRAM_FILE = "", parameter TC_FILE = ""
) (
    `MESH_PORTS, input tick
);
    `EXCHANGE
    localparam FLOOR = PACKET_WIDTH + 1, THRESHOLD = FLOOR + THRESHOLD_WIDTH, LEAK = THRESHOLD + THRESHOLD_WIDTH;
    localparam WEIGHT = LEAK + LEAK_WIDTH, RESET = WEIGHT + WEIGHT_WIDTH * NUM_WEIGHTS;
    localparam POTENTIAL = RESET + POTENTIAL_WIDTH, POINTS = POTENTIAL + POTENTIAL_WIDTH;
    CSRAM #(.NUM_NEURONS(NUM_NEURONS), .WIDTH(POINTS + NUM_AXONS)) CSRAM ();
    TokenController #(.NUM_AXONS(NUM_AXONS), .NUM_WEIGHTS(NUM_WEIGHTS)) TokenController ();
    reg [NUM_AXONS-1:0] due [0:NUM_TICKS-1];
    reg [POINTS+NUM_AXONS-1:0] row;
    reg signed [31:0] v, threshold, floor, reset;
    reg [$clog2(NUM_NEURONS)-1:0] CSRAM_addr = 0;
    reg [$clog2(NUM_TICKS)-1:0] now = 0;
    reg router_spike = 0;
    wire scheduler_clr = 0;
    integer n = 0, axon;
    initial for (axon = 0; axon < NUM_TICKS; axon = axon + 1) due[axon] = 0;

    always @(posedge clk) begin
        router_spike <= 0;
        if (scheduler_wen)
            due[(now + scheduler_packet[$clog2(NUM_TICKS)-1:0]) % NUM_TICKS][scheduler_packet >> $clog2(NUM_TICKS)] = 1;
        if (!TokenController.state && tick) begin
            TokenController.state <= 1;
            now = now + 1;
            n = 0;
        end else if (TokenController.state) begin
            row = CSRAM.memory[n];
            v = $signed(row[POTENTIAL +: POTENTIAL_WIDTH]) + $signed(row[LEAK +: LEAK_WIDTH]);
            for (axon = 0; axon < NUM_AXONS; axon = axon + 1)
                if (row[POINTS + axon] && due[(now - 1'b1) % NUM_TICKS][axon])
                    v = v + $signed(row[WEIGHT + WEIGHT_WIDTH * (NUM_WEIGHTS - 1
                        - TokenController.neuron_instructions[axon]) +: WEIGHT_WIDTH]);
            threshold = $signed(row[THRESHOLD +: THRESHOLD_WIDTH]);
            floor = $signed(row[FLOOR +: THRESHOLD_WIDTH]);
            reset = $signed(row[RESET +: POTENTIAL_WIDTH]);
            CSRAM_addr <= n;
            if (v >= threshold) begin
                router_spike <= 1;
                route(row[PACKET_WIDTH-1:0]);
                v = row[PACKET_WIDTH] ? v - threshold : reset;
            end else if (v < floor) v = row[PACKET_WIDTH] ? v - floor : -reset;
            CSRAM.memory[n][POTENTIAL +: POTENTIAL_WIDTH] <= v;
            n = n + 1;
            if (n == NUM_NEURONS) begin
                TokenController.state <= 0;
                due[(now - 1'b1) % NUM_TICKS] = 0;
            end
        end
    end
endmodule
